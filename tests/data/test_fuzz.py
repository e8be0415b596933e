"""Every reader reads thousands of damaged files, or refuses them by typed errors of one line (`pytest -m slow`)."""

import random
import shutil

import pytest

from nmpm.errors import NmpmError
from tests.data.fuzzing import damage, random_changes, readers

pytest.importorskip("msgpack", reason="the extra `convert` is not installed")
READERS = readers()
TRIES = 500


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_read(name, tmp_path):
    READERS[name].try_content(tmp_path, READERS[name].content)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_give_typed_errors(name, tmp_path):
    reader, errors = READERS[name], list[str]()
    for seed in range(TRIES):
        changes = random_changes(random.Random(f"{name} {seed}"))
        try:
            reader.try_content(tmp_path / "data", damage(reader.content, changes))
        except NmpmError as error:
            errors.append(str(error))
        shutil.rmtree(tmp_path / "data")
    assert len(errors) > TRIES // 5
    assert not [error for error in errors if "\n" in error]
