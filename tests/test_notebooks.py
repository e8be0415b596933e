"""The notebooks run from top to bottom."""

import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from nmpm.zoo import Zoo

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"


@pytest.mark.slow
@pytest.mark.skipif("goop" not in Zoo.list(), reason="the zoo holds no goop model")
def test_fine_tuning_changes_the_model_and_leaves_a_picture(tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    cells = json.loads((NOTEBOOKS / "fine_tuning.ipynb").read_text())["cells"]
    names: dict = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    tuned, pretrained = names["model"].emulator.state_dict(), names["pretrained"].emulator.state_dict()
    assert any(not torch.equal(tuned[name], value) for name, value in pretrained.items())
    assert torch.equal(tuned["input_mean"], pretrained["input_mean"])
    assert 0 <= names["after"] < 1
    assert Image.open("fine_tuned.png").width > 300
