"""Every reader takes damaged files apart from valid ones, or reads them; only typed errors come out."""

import shutil
from contextlib import suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nmpm.errors import NmpmError
from tests.data.fuzzing import BLOCKS, KINDS, Change, damage, readers

pytest.importorskip("msgpack", reason="the extra `convert` is not installed")

CHANGE = st.tuples(
    st.sampled_from(sorted(set(KINDS))),
    st.floats(0, 1),
    st.one_of(st.binary(min_size=1, max_size=9), st.sampled_from(BLOCKS)),
)
READERS = readers()


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_read(name, tmp_path):
    READERS[name].try_content(tmp_path, READERS[name].content)


@pytest.mark.parametrize("name", READERS)
@given(changes=st.lists(CHANGE, min_size=1, max_size=3))
@settings(max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
def test_damaged_files_give_typed_errors(name, tmp_path_factory, changes: list[Change]):
    folder = tmp_path_factory.mktemp("fuzz")
    try:
        with suppress(NmpmError):
            READERS[name].try_content(folder, damage(READERS[name].content, changes))
    finally:
        shutil.rmtree(folder)
