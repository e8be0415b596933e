"""The notebooks run from top to bottom with public names only, and are stored with what a run showed."""

import ast
import base64
import json
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest
import torch
from PIL import Image

from nmpm.zoo import Zoo

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
PUBLIC = ("nmpm", "nmpm.obstacles", "nmpm.processors", "nmpm.sim", "nmpm.testing", "nmpm.viz", "nmpm.zoo")
BUDGETS: dict[str, dict[str, object]] = {
    "quickstart": {"FRAMES": 16},
}
"""Constants of the notebooks, by what they are here; only how much is computed changes."""
if not NOTEBOOKS.is_dir():
    pytest.skip("notebooks are not part of this distribution", allow_module_level=True)

PATHS = sorted(NOTEBOOKS.glob("*.ipynb"))
every_notebook = pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)


def read_cells(path: Path) -> list[dict[str, Any]]:
    cells: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def read_code(path: Path) -> list[str]:
    return ["".join(cell["source"]) for cell in read_cells(path)]


def public_names(module: str) -> set[str]:
    found = import_module(module)
    return set(getattr(found, "__all__", [name for name in vars(found) if not name.startswith("_")]))


def shrink(code: str, budget: dict[str, object]) -> str:
    """The code with other values of its constants, each of which it must set once."""
    for name, value in budget.items():
        code, found = re.subn(rf"^{name} = [^#\n]*", f"{name} = {value!r}  ", code, flags=re.MULTILINE)
        assert found == 1, f"{name} is set {found} times"
    return code


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A function that runs a notebook in an empty folder, with its own cache and no network, and returns its names."""

    def run(name: str) -> dict[str, Any]:
        names: dict[str, Any] = {}
        code = shrink("\n".join(read_code(NOTEBOOKS / f"{name}.ipynb")), BUDGETS[name])
        exec(compile(code, name, "exec"), names)
        return names

    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    backend = plt.get_backend()
    plt.switch_backend("Agg")
    yield run
    plt.close("all")
    plt.switch_backend(backend)


@every_notebook
def test_notebooks_import_public_names_only(path):
    nodes = list(ast.walk(ast.parse("\n".join(read_code(path)))))
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module.startswith("nmpm")]
    assert imports
    for node in imports:
        assert node.module in PUBLIC
        assert {name.name for name in node.names} <= public_names(node.module), node.module


@every_notebook
def test_notebooks_are_stored_as_one_run_left_them(path):
    if path.stem == "fine_tuning":
        pytest.skip("stored without outputs")
    cells = read_cells(path)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert outputs
    assert not [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"]
    pictures = [output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert pictures
    assert max(len(base64.b64decode(picture)) for picture in pictures) < 100_000
    text = path.read_text(encoding="utf-8")
    assert len(text) < 1_000_000
    assert not re.search(r"Warning|Traceback|/home/|/root/|/tmp/|site-packages", text)


def test_quickstart_predicts_a_scene_and_leaves_pictures(run):
    names = run("quickstart")
    assert names["predicted"].shape == (16, len(names["start"].position), 2)
    assert 0 < names["error"][-1] < names["still"][-1]
    assert Image.open("quickstart.png").width > 300


@pytest.mark.slow
@pytest.mark.skipif("goop" not in Zoo.list(), reason="the zoo holds no goop model")
def test_fine_tuning_changes_the_model_and_leaves_a_picture(tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for cell in read_code(NOTEBOOKS / "fine_tuning.ipynb"):
        exec(cell, names)
    tuned, pretrained = names["model"].emulator.state_dict(), names["pretrained"].emulator.state_dict()
    assert any(not torch.equal(tuned[name], value) for name, value in pretrained.items())
    assert torch.equal(tuned["input_mean"], pretrained["input_mean"])
    assert 0 <= names["after"] < 1
    assert Image.open("fine_tuned.png").width > 300
