import os

import pytest

from nmpm._support.bounded_files import check_plain, parse_yaml, read_bounded, read_yaml, to_yaml
from nmpm.errors import DataError


def test_plain_data_are_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("\ufeffa: 1\nb: [0.5, true, null, text, '2026-01-01']\nc: {d: é}\n", encoding="utf-8")
    assert read_yaml(path) == {"a": 1, "b": [0.5, True, None, "text", "2026-01-01"], "c": {"d": "é"}}
    assert parse_yaml("# nothing\n", "a.yaml") == {}
    assert parse_yaml("a: &x [1]\nb: [*x, *x]\n", "a.yaml") == {"a": [1], "b": [[1], [1]]}


def test_what_is_written_is_read_again_numbers_without_a_point_too():
    content = {"a": 1e-07, "b": "12e45", "c": "1.e+5", "d": "1e-3 s", "f": "é ×10⁻³ 💡\n\t", "g": [None, True]}
    assert parse_yaml(to_yaml(content), "") == content
    assert parse_yaml("a: [1e-3, 4e5, -2.5E+3, 1e, e5]", "") == {"a": [1e-3, 4e5, -2500.0, "1e", "e5"]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &x [1, *x]\n", "line 1: nested more than 32 deep, or aliases repeat too much"),
        (f"a: &x [{'1, ' * 999}1]\nb: [{'*x, ' * 100}1]\n", "aliases repeat too much"),
        ("a: " + "[" * 400_000, "nested more than 32 deep"),
        ("a: !!python/object/apply:os.system ['true']\n", "could not determine a constructor"),
        ("a: " + "9" * 400 + "\n", "an integer of more than 63 bits"),
        ("a: 2026-11-21\n", "holds the date 2026-11-21; quote it"),
        ("1: a\n", "the key 1 is not a string"),
        ('a: "b\\e]0;c\\a"\n', "has a control character"),
        ("a: [1\n", "cannot be read"),
    ],
)
def test_other_yaml_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read_yaml(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 300


def test_values_that_contain_themselves_many_times_are_refused():
    value: list = [1]
    for _ in range(30):
        value = [value, value]
    with pytest.raises(DataError, match="nested"):
        check_plain({"a": value}, "here")


def test_only_regular_files_of_bounded_size_are_opened(tmp_path):
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(2**40)  # sparse
    with pytest.raises(DataError, match="more than 10 bytes"):
        read_bounded(path, 10)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe", tmp_path / "link", tmp_path):
        with pytest.raises(DataError, match="not a regular file"):
            read_bounded(path, 10)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("nothing", "loop", "x" * 300):
        with pytest.raises(DataError, match="No such file"):
            read_bounded(tmp_path / name, 10)
