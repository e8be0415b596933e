"""Registries: built-in parts first, then those of installed packages, by entry points."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from nmpm.errors import ConfigError
from nmpm.registry import Registry


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Installs a package with these entry points of the group `nmpm.examples`, as `pip` does."""

    def install(package: str, **points: str) -> None:
        folder = tmp_path / package / f"{package}-1.0.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = [f"{name} = {value}\n" for name, value in points.items()]
        (folder / "entry_points.txt").write_text(f"[nmpm.examples]\n{''.join(lines)}")
        monkeypatch.syspath_prepend(str(tmp_path / package))

    return install


def examples() -> Registry[float]:
    return Registry("nmpm.examples", "example", {"pi": "math:pi"})


def test_built_in_parts_come_first_and_plugins_after_them(install):
    install("others", e="math:e")
    registry = examples()
    assert list(registry) == ["pi", "e"]
    assert list(registry.values()) == [math.pi, math.e]


def test_an_unknown_name_gets_the_names_and_the_nearest(install):
    install("others", euler="math:e")
    with pytest.raises(ConfigError, match=r"There is no example 'eule'; there are pi, euler. Did you mean euler\?"):
        examples()["eule"]
    assert "eule" not in examples()


@pytest.mark.parametrize("value", ["no_such_module:part", "math:no_such_name"])
def test_a_plugin_that_cannot_be_imported_is_named_when_it_is_asked_for(install, value):
    install("broken", e=value)
    registry = examples()
    assert registry["pi"] == math.pi
    with pytest.raises(ConfigError, match=rf"example 'e' of the package broken \({value}\) cannot be imported"):
        registry["e"]


@pytest.mark.parametrize(("first", "name"), [("nmpm", "pi"), ("aaa", "e")])
def test_a_name_that_is_taken_stays_the_part_that_has_it(install, first, name):
    install("aaa", e="math:e")
    install("bbb", **{name: "math:tau"})
    registry = examples()
    with pytest.warns(UserWarning, match=f"example '{name}' of the package bbb is not used: {first} has one"):
        assert sorted(registry) == ["e", "pi"]
    assert registry[name] == {"pi": math.pi, "e": math.e}[name]
