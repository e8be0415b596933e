"""A format of another package: the reader of the how-to, installed by its entry point."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nmpm.cli import main
from nmpm.data.convert import READERS, Options, native_folder, open_dataset
from nmpm.errors import ConfigError

PAGE = Path(__file__).parents[3] / "docs" / "howto" / "converter.md"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package on the path, with the reader `raw` and another that cannot be imported."""
    source = re.search(r"```python\n(.*?)\n\nsource = ", PAGE.read_text(), re.DOTALL)
    folder = tmp_path / "site"
    info = folder / "raw_reader-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "raw_reader.py").write_text(source[1])
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: raw-reader\nVersion: 1.0\n")
    points = info / "entry_points.txt"
    points.write_text("[nmpm.readers]\nraw = raw_reader:Raw\n")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(READERS.__dict__, "plugins", raising=False)
    monkeypatch.setattr(READERS, "_loaded", {})
    yield points
    READERS.__dict__.pop("plugins", None)


@pytest.fixture
def runs(tmp_path):
    folder = tmp_path / "runs"
    folder.mkdir()
    for run in range(3):
        position = np.random.default_rng(run).uniform(0.2, 0.8, (30, 50, 2)).astype(np.float32)
        (folder / f"{run}.raw").write_bytes(np.array(position.shape, np.int32).tobytes() + position.tobytes())
    return folder


def test_commands_and_python_read_the_format_of_a_plugin(package, runs, tmp_path, capsys):
    assert main(["convert", str(runs), str(tmp_path / "native"), "--gravity=0,-9.81"]) == 0
    assert "Frames are 0.01 s apart." in capsys.readouterr().out
    assert main(["inspect", str(runs)]) == 0
    assert native_folder(runs).is_dir()  # as `fit` and `load_trajectories` read it
    assert set(open_dataset(runs, "raw", Options(files="*.raw")).splits) == {"train", "valid", "test"}


def test_help_and_suggestions_know_the_format_of_a_plugin(package, runs, capsys):
    with pytest.raises(ConfigError, match=r"no format 'row'; there are native, .*, raw. Did you mean raw\?"):
        open_dataset(runs, "row")
    with pytest.raises(SystemExit, match="0"):
        main(["convert", "--help"])
    assert re.search(r"tecplot .*\n\s*raw +a .raw file for each run", capsys.readouterr().out)


def test_a_plugin_that_cannot_be_imported_is_named(package, runs, capsys):
    package.write_text("[nmpm.readers]\nraw = no_such_module:Raw\n")
    assert main(["inspect", str(runs)]) == 1
    assert "format 'raw' of the package raw-reader (no_such_module:Raw) cannot be imported" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        main(["convert", "--help"])
    assert "cannot be imported" in re.sub(r"\s+", " ", capsys.readouterr().out)


def test_the_list_of_formats_imports_no_reader():
    script = """
import sys
import nmpm.data.convert
inside = {name for name in sys.modules if name.startswith("nmpm.data.convert.")}
assert inside == {"nmpm.data.convert.base"}, inside
assert not {"scipy.signal", "nmpm.data.facts"} & {*sys.modules}
"""
    subprocess.run([sys.executable, "-c", script], check=True)
