import os

import pytest

from nmpm._support import bounded_files
from nmpm._support.bounded_files import parse_yaml, read_bounded, read_yaml, to_yaml
from nmpm.errors import DataError


def test_plain_data_are_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\nb: [0.5, true, null, text, '2026-01-01']\nc: {d: é}\n", encoding="utf-8")
    assert read_yaml(path) == {"a": 1, "b": [0.5, True, None, "text", "2026-01-01"], "c": {"d": "é"}}
    assert parse_yaml("# nothing\n", "a.yaml") == {}


def test_what_is_written_is_read_again_numbers_without_a_point_too():
    content = {"a": 1e-07, "b": "12e45", "c": "1.e+5", "d": "1e-3 s", "e": 1e30, "f": "é", "g": [None, True, "true"]}
    assert parse_yaml(to_yaml(content), "") == content
    assert parse_yaml("a: [1e-3, 4e5, -2.5E+3, 1e, e5]", "") == {"a": [1e-3, 4e5, -2500.0, "1e", "e5"]}


@pytest.mark.parametrize("c_loader", [True, False])
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &x [1, *x]\n", r"line 1: \*x stands for nothing before it"),
        (f"a: &x [{'1, ' * 99}1]\nb: [{'*x, ' * 100}1]\n", "line 2: aliases stand for more than 10,000 values"),
        ("a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 40)), "nested more than 32 deep"),
        ("a: !!python/object/apply:os.system ['true']\n", "has the tag"),
        ("a: !!int '3'\n", "has the tag"),
        ("a: " + "[" * 33 + "]" * 33 + "\n", "nested more than 32 deep"),
        ("a: " + "[" * 400_000, "nested more than 32 deep"),
        ("a: " + "9" * 400 + "\n", "a number of more than 100 digits"),
        ("a: 1" + ":1" * 400_000 + "\n", "a number of more than 100 digits"),
        ("a: 0x" + "f" * 5000 + "\n", None),
        ("a: 2026-11-21\n", "holds the date 2026-11-21; quote it"),
        ("a: 2026-13-45\n", "cannot be read"),
        ("1: a\n", "its key 1 is not a string"),
        ('a: "b\\e]0;c\\a"\n', "has a control character"),
        ('"a\\x9b": 1\n', "has a control character"),
        ("- a\n", "should hold keys and values"),
        ("a: 1\n---\nb: 1\n", "cannot be read"),
        ("a: [1\n", "cannot be read"),
        ("a: \x07\n", "cannot be read"),
        ("a: =\n", "cannot be read"),
    ],
)
def test_other_yaml_is_refused_at_once(tmp_path, monkeypatch, text, message, c_loader):
    if not c_loader:
        monkeypatch.setattr(bounded_files, "_LOADER", bounded_files.yaml.SafeLoader)
    path = tmp_path / "a.yaml"
    path.write_text(text)
    if message is None:
        assert read_yaml(path)["a"] == int("f" * 5000, 16)
        return
    with pytest.raises(DataError, match=message) as caught:
        read_yaml(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 300


def test_text_keeps_its_lines_and_characters(tmp_path):
    (tmp_path / "a.yaml").write_text('a: "line\\nline\\t×10⁻³ \\U0001F4A1"\n')
    assert read_yaml(tmp_path / "a.yaml") == {"a": "line\nline\t×10⁻³ \U0001f4a1"}


def test_a_byte_order_mark_is_skipped(tmp_path):
    (tmp_path / "a.yaml").write_text("\ufeffa: 1\n", encoding="utf-8")
    assert read_yaml(tmp_path / "a.yaml") == {"a": 1}


def test_large_files_are_not_read(tmp_path):
    path = tmp_path / "a.yaml"
    with path.open("wb") as file:
        file.truncate(2**40)  # sparse
    with pytest.raises(DataError, match="more than 1,048,576 bytes"):
        read_yaml(path)
    path.write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(DataError, match="cannot be read"):
        read_yaml(path)


def test_only_regular_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe", tmp_path / "link", tmp_path):
        with pytest.raises(DataError, match="not a regular file"):
            read_bounded(path, 10)
    with pytest.raises(DataError, match="No such file"):
        read_bounded(tmp_path / "nothing", 10)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(DataError, match="symbolic links"):
        read_bounded(tmp_path / "loop", 10)
