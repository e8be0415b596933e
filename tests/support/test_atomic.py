"""Files and folders appear whole or not at all."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress

import pytest

from nmpm._support.atomic import atomic_folder, atomic_write, lock_folder, new_folder, temporary_files


def files_of(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def write(path, text):
    with atomic_folder(path) as new:
        (new / "inner").mkdir()
        (new / "inner" / "file").write_text(text)


def test_a_folder_takes_the_place_of_a_former_one_as_a_whole(tmp_path):
    write(tmp_path / "deep" / "one", "first")
    (tmp_path / "deep" / "one" / "other").write_text("of the former")
    write(tmp_path / "deep" / "one", "second")
    assert files_of(tmp_path) == {"deep/one/inner/file": "second"}
    mask = os.umask(0)
    os.umask(mask)
    assert (tmp_path / "deep" / "one").stat().st_mode & 0o777 == 0o777 & ~mask


def killed(writer, path, patch=""):
    """Kill a process that writes a folder, after its files or where `patch` says so."""
    script = f"""
import os, signal
from pathlib import Path
from nmpm._support import atomic
{patch}
with atomic.{writer}(Path({str(path)!r})) as new:
    (new / "file").write_text("of the killed")
    if not {patch!r}:
        os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -signal.SIGKILL


BETWEEN_RENAMES = """
rename = os.replace
def replace(source, target):
    if str(source).endswith(".new"):
        os.kill(os.getpid(), signal.SIGKILL)
    rename(source, target)
os.replace = replace
"""


def test_what_a_killed_process_left_is_cleared_by_the_next_one(tmp_path):
    name = "[o]*?" + "o" * 195
    killed("new_folder", tmp_path / name)
    killed("atomic_folder", tmp_path / f"{name}.other")
    assert not (tmp_path / name).exists()
    with atomic_folder(tmp_path / name) as new, new_folder(tmp_path / f"{name}s") as other:
        (new / "file").write_text("whole")
        (other / "file").write_text("another")
    shown = {path: text for path, text in files_of(tmp_path).items() if not path.startswith(".")}
    assert shown == {f"{name}/file": "whole", f"{name}s/file": "another"}
    assert "of the killed" in files_of(tmp_path).values()  # what was left for another path stays
    write(tmp_path / f"{name}.other", "next")
    assert not list(tmp_path.glob(".*"))


def test_a_former_folder_comes_back_after_a_kill_between_two_renames(tmp_path):
    write(tmp_path / "one", "first")
    killed("atomic_folder", tmp_path / "one", BETWEEN_RENAMES)
    assert not (tmp_path / "one").exists()
    with pytest.raises(TypeError):
        write(tmp_path / "one", None)
    assert files_of(tmp_path) == {"one/inner/file": "first"}


@pytest.mark.parametrize("kind", [threading.Thread, multiprocessing.get_context("fork").Process])
def test_a_locked_folder_is_waited_for(tmp_path, kind, caplog):
    def work():
        with lock_folder(tmp_path / "deep"):
            (tmp_path / "deep" / "file").write_text("second")

    with lock_folder(tmp_path / "deep"):
        other = kind(target=work)
        other.start()
        time.sleep(0.2)
        assert not (tmp_path / "deep" / "file").exists()
    other.join()
    assert (tmp_path / "deep" / "file").read_text() == "second"


def test_a_new_folder_replaces_none_that_holds_files(tmp_path):
    (tmp_path / "one").mkdir()
    for text in ("first", "second"):
        with suppress(OSError), new_folder(tmp_path / "one") as new:
            (new / "file").write_text(text)
    assert files_of(tmp_path) == {"one/file": "first"}


def test_a_file_is_old_or_new_and_two_writers_write_a_file_each(tmp_path):
    path = tmp_path / "deep" / "one"
    with atomic_write(path) as first, atomic_write(path) as second:
        first.write_text("first")
        second.write_text("second")
        assert set(temporary_files(path.parent)) == {first, second}
    assert files_of(tmp_path) == {"deep/one": "first"}


def test_a_full_disk_is_told_of_the_file_and_leaves_no_half_of_it(tmp_path):
    def fill_disk():
        with atomic_write(tmp_path / "one") as part:
            part.write_text("half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as the system does: of no file

    with pytest.raises(OSError, match=r"No space left on device: '.*/one'"):
        fill_disk()
    assert not files_of(tmp_path)
