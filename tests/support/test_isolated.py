import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nmpm._support.isolated import call_isolated, iterate_isolated
from nmpm.errors import ConfigError, DataError


def values(path: Path, *arguments: object) -> list[object]:
    os.write(1, b"parsers may print")
    arrays = [np.eye(3, dtype="f4"), np.zeros((0, 2)), np.array(["a", "bc"]), np.array([[True], [False]]), np.int8(3)]
    return [path.name, None, 0.5, {"text": "é"}, list(arguments), *map(np.asarray, arrays)]


def count(path: Path, most: int) -> Iterator[tuple[int, int]]:
    for number in range(most):
        yield number, os.getpid()


def process(path: Path) -> int:
    return os.getpid()


def abort(path: Path) -> None:
    os.abort()


def allocate(path: Path, size: int) -> int:
    return int(np.ones(size, np.int8).sum())


def refuse(path: Path) -> None:
    raise ConfigError(f"{path.name}: not so")


def fail(path: Path) -> None:
    raise KeyError("broken")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"12345")
    return path


def test_plain_data_and_arrays_come_back(file):
    name, nothing, number, mapping, arguments, *arrays = call_isolated(values, file, 1, "x", [2.5])
    assert (name, nothing, number, mapping, arguments) == ("a.bin", None, 0.5, {"text": "é"}, [1, "x", [2.5]])
    for array, expected in zip(arrays, values(file)[5:], strict=True):
        assert array.dtype == expected.dtype
        np.testing.assert_array_equal(array, expected)


def test_one_child_serves_call_after_call_also_after_errors_and_unfinished_ones(file):
    child = call_isolated(process, file)
    assert child != os.getpid()
    assert [number for number, _ in iterate_isolated(count, file, 3)] == [0, 1, 2]
    for first, owner in iterate_isolated(count, file, 10**9):
        assert (first, owner) == (0, child)
        break
    with pytest.raises(ConfigError, match=r"^a\.bin: not so$"):
        call_isolated(refuse, file)
    with pytest.raises(DataError, match="broken"):
        call_isolated(fail, file)
    assert call_isolated(process, file) == child


def test_calls_within_calls_have_children_of_their_own(file):
    pairs = [(a, b) for a, b in zip(iterate_isolated(count, file, 3), iterate_isolated(count, file, 3), strict=True)]
    assert [(a[0], b[0]) for a, b in pairs] == [(0, 0), (1, 1), (2, 2)]


def test_a_crash_is_one_error_and_the_next_call_works(file):
    with pytest.raises(DataError, match=r"a\.bin: cannot be read: its parser ended \(SIGABRT\)") as error:
        call_isolated(abort, file)
    assert "\n" not in str(error.value)
    assert call_isolated(process, file) != os.getpid()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux alone")
def test_memory_is_limited_by_the_size_of_the_file(file):
    assert call_isolated(allocate, file, 2**20) == 2**20
    with pytest.raises(DataError, match=r"a\.bin"):
        call_isolated(allocate, file, 2**32)


def test_a_child_that_was_idle_for_long_ends_and_is_replaced(file, monkeypatch):
    monkeypatch.setattr(
        "nmpm._support.isolated._START", "import nmpm._support.isolated as i; i._IDLE_SECONDS = 0.1; i.serve()"
    )
    with pytest.raises(DataError):
        call_isolated(abort, file)
    first = call_isolated(process, file)
    for _ in range(200):
        if Path(f"/proc/{first}/stat").exists() and " Z " not in Path(f"/proc/{first}/stat").read_text():
            time.sleep(0.05)
    assert call_isolated(process, file) != first
