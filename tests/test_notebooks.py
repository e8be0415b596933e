"""The notebooks run from top to bottom, with public names only."""

import ast
import json
from pathlib import Path

import pytest
import torch
from PIL import Image

import nmpm
import nmpm.viz
from nmpm.zoo import Zoo

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
PUBLIC = {"nmpm": nmpm.__all__, "nmpm.viz": nmpm.viz.__all__}
if not NOTEBOOKS.is_dir():
    pytest.skip("notebooks are not part of this distribution", allow_module_level=True)


def read_code(path: Path) -> list[str]:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebooks_import_public_names_only(path):
    nodes = list(ast.walk(ast.parse("\n".join(read_code(path)))))
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module.startswith("nmpm")]
    assert imports
    for node in imports:
        assert {name.name for name in node.names} <= set(PUBLIC.get(node.module, ())), node.module


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
