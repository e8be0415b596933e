import sys
from pathlib import Path

import pytest

from nmpm._support.plain_data import from_spec, load_plugins
from nmpm.errors import ConfigError
from nmpm.processors import Processor

MODULE = '''
from dataclasses import dataclass
from nmpm.processors import Pointwise

@dataclass(frozen=True)
class Mine(Pointwise):
    """A processor of somebody else's package."""
'''


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package with an entry point, as pip would leave it in site-packages."""

    def install(name: str, source: str) -> Path:
        (tmp_path / f"{name}.py").write_text(source)
        info = tmp_path / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[nmpm.plugins]\nmine = {name}\n")
        monkeypatch.syspath_prepend(tmp_path)
        load_plugins.cache_clear()
        return tmp_path

    yield install
    load_plugins.cache_clear()


def test_an_installed_processor_can_be_named_by_its_class(installed):
    installed("someones_processor", MODULE)
    made = from_spec({"class_path": "someones_processor.Mine", "init_args": {"hidden": [3]}}, Processor)
    assert type(made).__name__ == "Mine"
    assert made.hidden == (3,)


def test_a_broken_plugin_is_named(installed):
    installed("broken_processor", "raise RuntimeError('no luck')")
    with pytest.raises(ConfigError, match="plugin broken_processor of broken_processor cannot be imported: no luck"):
        load_plugins()


def test_a_class_that_nobody_installed_is_not_imported(tmp_path, monkeypatch):
    (tmp_path / "loose_module.py").write_text("raise SystemExit('run')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"'loose_module\.Evil' is not known"):
        from_spec({"class_path": "loose_module.Evil"}, Processor)
    assert "loose_module" not in sys.modules
