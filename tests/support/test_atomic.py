"""Files and folders appear whole or not at all."""

import os

import pytest

from nmpm._support.atomic import atomic_folder, atomic_write


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


def test_a_former_folder_stays_if_its_successor_fails(tmp_path):
    write(tmp_path / "one", "first")
    with pytest.raises(TypeError):
        write(tmp_path / "one", None)
    assert files_of(tmp_path) == {"one/inner/file": "first"}


def test_a_former_folder_comes_back_if_the_new_one_cannot_be_renamed(tmp_path, monkeypatch):
    write(tmp_path / "one", "first")
    rename = os.replace

    def refuse(source, target):
        if str(source).endswith("new"):
            raise OSError("no space left on device")
        rename(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="no space"):
        write(tmp_path / "one", "second")
    assert files_of(tmp_path) == {"one/inner/file": "first"}


def test_a_file_is_old_or_new(tmp_path):
    with atomic_write(tmp_path / "deep" / "one") as part:
        part.write_text("first")
    assert files_of(tmp_path) == {"deep/one": "first"}
    with pytest.raises(TypeError), atomic_write(tmp_path / "deep" / "one") as part:
        part.touch() or part.write_text(None)
    assert files_of(tmp_path) == {"deep/one": "first"}
