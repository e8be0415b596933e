"""The notebooks run from top to bottom with public names only, and are stored with what a run showed."""

import ast
import base64
import json
import logging
import re
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from nmpm import Zoo

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
PUBLIC = (
    "nmpm",
    "nmpm.cli",
    "nmpm.obstacles",
    "nmpm.optimizers",
    "nmpm.processors",
    "nmpm.sim",
    "nmpm.testing",
    "nmpm.viz",
    "nmpm.zoo",
)
BUDGETS: dict[str, dict[str, object]] = {
    "fine_tuning": {"STEPS": 30, "RUNS, FRAMES": (4, 80)},
    "inverse_design": {"LAST": 8, "FRAMES": 8, "STARTS": 2, "SECONDS": 0.6},
    "new_processor": {"STEPS": 2, "COUNTS": {"train": 1, "valid": 1, "test": 1}, "FRAMES": 40},
    "quickstart": {"FRAMES": 16},
    "speed_accuracy": {"TABLES": str(NOTEBOOKS.parent / "benchmarks" / "trade"), "FRAMES": 4, "ROUNDS": 1},
    "your_own_data": {"RUNS, FRAMES, PARTICLES": (4, 60, 60), "STEPS": 2},
}
"""Constants of the notebooks, by what they are here; only how much is computed changes."""
LOADED = re.compile(r'Zoo\.load\("([\w/-]+)"(?:, variant="(\w+)")?')
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
        module = ModuleType(f"notebook_{name}")  # where its classes are looked up
        monkeypatch.setitem(sys.modules, module.__name__, module)
        code = shrink("\n".join(read_code(NOTEBOOKS / f"{name}.ipynb")), BUDGETS[name])
        exec(compile(code, name, "exec"), vars(module))
        return vars(module)

    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    logger, backend = logging.getLogger("lightning.pytorch"), plt.get_backend()
    level = logger.level
    plt.switch_backend("Agg")
    yield run
    plt.close("all")
    plt.switch_backend(backend)
    logger.setLevel(level)


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
    cells = read_cells(path)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert outputs
    assert not [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"]
    pictures = [output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert pictures
    assert max(len(base64.b64decode(picture)) for picture in pictures) < 100_000
    assert path.stat().st_size < 1_000_000
    texts = [str(output.get("text") or output.get("data", {}).get("text/plain")) for output in outputs]
    assert not re.search(r"Warning|Traceback|/home/|/root/|/tmp/|site-packages", "\n".join(texts))


@every_notebook
def test_notebooks_are_stored_as_the_shipped_weights_left_them(path):
    """Outputs belong to weights: after a training, `python benchmarks/run_notebooks.py` runs them again."""
    names = {"/".join(filter(None, match)) for match in LOADED.findall("\n".join(read_code(path)))} & set(Zoo.list())
    shipped = {name: Zoo.card(name)["sha256"][:12] for name in names}
    assert json.loads(path.read_text(encoding="utf-8"))["metadata"].get("weights") == shipped


def test_quickstart_predicts_a_scene_and_leaves_pictures(run):
    names = run("quickstart")
    assert names["predicted"].shape == (16, names["simulated"].shape[1], 2)
    assert 0 < names["error"][-1] < names["still"][-1]
    assert Image.open("quickstart.png").width > 300


def test_inverse_design_descends_within_its_limits(run):
    names = run("inverse_design")
    assert all(search.best[0] < search.trace[0][1] for search in names["throws"]["gradients"])
    best = [search.best[1] for searches in names["throws"].values() for search in searches]
    assert np.abs(best).max() <= names["throw"].limit
    assert all(0 < value < 1 for groups in names["table"].values() for group in groups for value in group)
    assert Image.open("inverse_design.gif").n_frames > 1


def test_a_new_processor_passes_the_contract_and_learns(run):
    trained = run("new_processor")["trained"]
    assert {name: steps for name, (_, steps, _) in trained.items()} == {"dilated": 2, "U-Net": 2}
    assert all(0 < errors["test/mse"] < 1 for *_, errors in trained.values())


def test_speed_and_accuracy_read_the_committed_tables(run):
    names = run("speed_accuracy")
    for lines in names["tables"].values():
        assert {line["kind"] for line in lines} >= {"model", "simulator", "trivial"}
        assert names["best"](lines, "simulator", 1000.0)["mse"] == 0  # the reference itself
        assert names["best"](lines, "model", 0.0) is None
    assert all(len(taken) == 1 for taken in names["seconds"].values())


@pytest.fixture(params=["made up", pytest.param("sample", marks=pytest.mark.slow)])
def foreign_data(request, monkeypatch):
    """Grains that the notebooks make up, or those of the recorded data."""
    if request.param == "sample":
        request.getfixturevalue("recorded")
    else:
        monkeypatch.delenv("NMPM_TEST_DATA", raising=False)


@pytest.mark.usefixtures("foreign_data")
def test_your_own_data_become_a_film_and_a_model_that_anybody_can_load(run):
    names = run("your_own_data")
    assert names["predicted"].shape == (58, 60, 2)
    assert names["theirs"].card["name"] == "blocks/mine"
    assert Image.open("blocks.png").width > 300
    assert Image.open("film.gif").n_frames > 1


@pytest.mark.usefixtures("foreign_data")
def test_fine_tuning_takes_foreign_data_and_leaves_a_better_model_and_a_picture(run):
    names = run("fine_tuning")
    assert names["start"].match.reading.scene.materials == ("sand",)
    assert min(names["overall"]) < 0.6 * names["overall"][0]  # 0.2 to 0.3 as measured
    mse = {name: float(curve.square().mean()) for name, curve in names["errors"].items()}
    assert mse["as it is"] < 0.15 * mse["nothing moves"] > mse["fine-tuned"]
    assert all(len(curve) == names["frames"] for curve in names["errors"].values())
    assert Image.open("fine_tuned.png").width > 300
