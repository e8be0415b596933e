import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from scenes import box, cloud, with_obstacle

from nmpm.cli import main
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.rollouts import unroll
from nmpm.errors import ConfigError
from nmpm.particles import Particles, lattice
from nmpm.processors import GridLayout, GridProcessor, Pointwise, Processor
from nmpm.scene import Scene
from nmpm.transfer import Affine, Linear, Nearest
from nmpm.zoo import export
from nmpm.zoo.export import FORMATS, Format, Network, Solid, Step, description

RUNNER = Path(__file__).parents[2] / "docs" / "run_onnx.py"
FREE = Constraints(solids=False)


def emulator_of(scene: Scene, constraints: Constraints = FREE, processor=None, transfer=None, gain=0.05) -> Emulator:
    torch.manual_seed(0)
    recipe = processor or Pointwise(hidden=(8,))
    cells = 12 if scene.dim == 2 else 6
    emulator = (
        EmulatorRecipe(scene, cells, frames=2, transfer=transfer or Linear(), processor=recipe, constraints=constraints)
        .build()
        .eval()
    )
    emulator.output_scale.mul_(gain)
    return emulator.requires_grad_(False)


def inputs_of(step: Step, particles: Particles) -> dict[str, torch.Tensor]:
    known = {
        "position": particles.position,
        "velocity": particles.velocity,
        "material": particles.material,
        "gravity": particles.gravity,
        "solid": step.emulator.solid(particles),
        "budget": torch.full((particles.position.shape[0],), float("nan")),
    }
    return {value.name: known[value.name] for value in step.inputs}


def rolled_out(session: onnxruntime.InferenceSession, inputs: dict[str, torch.Tensor], bundles: int) -> torch.Tensor:
    state = {name: value.numpy() for name, value in inputs.items()}
    frames = []
    for _ in range(bundles):
        positions, *following = session.run(None, state)
        frames.append(torch.from_numpy(positions))
        state |= {"position": positions[:, -1]} | dict(zip(("velocity", "budget"), following, strict=False))
    return torch.cat(frames, dim=1)


def apart(emulator: Emulator, one: torch.Tensor, other: torch.Tensor) -> float:
    """The largest difference of two paths, in cells."""
    return (one - other).abs().max().item() / min(emulator.grid.spacing)


def path_of(emulator: Emulator, particles: Particles, bundles: int) -> torch.Tensor:
    return torch.cat([bundle.position for bundle in unroll(emulator, particles, bundles)], dim=1)


EMULATORS = {
    "two materials, a periodic axis": lambda: emulator_of(
        box(materials=("water", "sand"), boundary=("periodic", "wall"), bounds=((0.08, 0.92), (0.1, 0.9))),
        transfer=Nearest(),
    ),
    "3-D, gravity varies, obstacles": lambda: emulator_of(box(dim=3, gravity_varies=True, obstacles=True)),
    "held": lambda: emulator_of(box(), Constraints(energy=True, rest_speed=0.02, density_cap=0.3), gain=1.0),
}


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Callable[[str], tuple[Emulator, Path]]:
    """The emulator of that name and its step as an ONNX file, written once."""
    folder = tmp_path_factory.mktemp("exported")

    def export_step(name: str) -> tuple[Emulator, Path]:
        path, emulator = folder / f"{name}.onnx", EMULATORS[name]()
        if not path.exists():
            part = Step(emulator)
            FORMATS["onnx"].write(part, description(part, "mine", "made up"), path)
        return emulator, path

    return export_step


def session_of(path: Path) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


PERIODIC, SPATIAL, HELD = EMULATORS
SOME = [PERIODIC, *(pytest.param(name, marks=pytest.mark.slow) for name in (SPATIAL, HELD))]  # each takes seconds


@pytest.mark.parametrize("name", SOME)
def test_an_onnx_step_is_the_emulator_for_any_number_of_scenes_and_particles(name, exported):
    emulator, path = exported(name)
    step, session = Step(emulator), session_of(path)
    for batch, count in ((1, 1), (3, 25)):
        particles = cloud(emulator.scene, count, batch, seed=count, statics=9 if emulator.scene.obstacles else 0)
        expected = path_of(emulator, particles, 10)
        found = rolled_out(session, inputs_of(step, particles), 10)
        assert apart(emulator, found[:, :2], expected[:, :2]) < 1e-5
        assert apart(emulator, found, expected) < 1e-4


@pytest.mark.slow
@pytest.mark.slow
def test_particles_keep_clear_of_obstacles_in_an_onnx_step(tmp_path):
    emulator, path = emulator_of(box(obstacles=True), Constraints(), gain=0.3), tmp_path / "contact.onnx"
    step, slab = Step(emulator), lattice(((0.3, 0.7), (0.35, 0.5)), 0.02)
    FORMATS["onnx"].write(step, description(step, "mine", "made up"), path)
    state = with_obstacle(cloud(emulator.scene, 25, 3, speed=0.02), slab)
    expected, session = path_of(emulator, state, 3), session_of(path)
    assert apart(emulator, path_of(emulator.unconstrained(), state, 3), expected) > 1
    assert apart(emulator, rolled_out(session, inputs_of(step, state), 3), expected) < 1e-4


def test_an_onnx_step_takes_a_budget_and_gives_the_one_that_it_kept(exported):
    emulator, path = exported(HELD)
    step, session, particles = Step(emulator), session_of(path), cloud(emulator.scene, 40, 2)
    assert apart(emulator, path_of(emulator, particles, 10), path_of(emulator.unconstrained(), particles, 10)) > 0.1
    for budget, kept in ((-1.0, [-1.0] * 2), (1e3, [1e3] * 2), (float("nan"), emulator.budget(particles).tolist())):
        given = inputs_of(step, particles) | {"budget": torch.full((2,), budget)}
        outputs = session.run(None, {key: value.numpy() for key, value in given.items()})
        assert outputs[2].tolist() == pytest.approx(kept)


def test_the_solid_fraction_by_itself(tmp_path):
    part, form = Solid(emulator_of(box(obstacles=True))), FORMATS["onnx"]
    form.write(part, {}, tmp_path / "part.onnx")
    assert form.difference(part, tmp_path / "part.onnx", batch=3, count=11) < 1e-5


def test_a_file_says_what_it_is(exported):
    emulator, path = exported(PERIODIC)
    scene, session = emulator.scene, session_of(path)
    about = session.get_modelmeta().custom_metadata_map
    assert about["model"] == "mine"
    assert about["training_data"] == "made up"
    assert Scene.from_dict(json.loads(about["scene"])) == scene
    assert json.loads(about["inputs"])["material"]["description"].endswith("0 water, 1 sand")
    assert [value.shape for value in session.get_inputs()] == [["B", "N", 2], ["B", "N", 2], ["B", "N"]]
    assert session.get_outputs()[0].shape == ["B", 2, "N", 2]
    model = onnx.load(path)
    assert model.graph.input[0].doc_string == "('B', 'N', 2) domain length"


@pytest.mark.slow
@pytest.mark.timeout(900)  # a C++ compiler at work
def test_a_compiled_package_is_the_emulator(tmp_path):
    emulator = EMULATORS[HELD]()
    part, form, path = Step(emulator), FORMATS["pt2"], tmp_path / "step.pt2"
    form.write(part, description(part, "mine", "made up"), path)
    for batch, count in ((1, 40), (3, 25)):
        assert form.difference(part, path, batch, count) < 1e-5
    inputs = part.example(1, 40)
    strided = inputs | {"position": inputs["position"].mT.contiguous().mT}  # the same numbers, otherwise laid out
    for one, other in zip(form.run(path, inputs), form.run(path, strided), strict=True):
        assert torch.equal(one, other)
    about = torch._inductor.aoti_load_package(str(path)).get_metadata()
    assert json.loads(about["scene"])["materials"] == ["goop"]


@pytest.mark.parametrize("name", SOME)
def test_numpy_and_onnxruntime_are_enough(name, exported, tmp_path):
    emulator, path = exported(name)
    scene = emulator.scene
    script = f"""
import runpy, sys
sys.modules.update(torch=None, nmpm=None)  # importing them raises
sys.argv = ["run_onnx.py", {str(path)!r}, "out.npy"]
runpy.run_path({str(RUNNER)!r})
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    found = torch.from_numpy(np.load(tmp_path / "out.npy"))
    spacing = scene.particle_volume ** (1 / scene.dim)
    axes = [np.arange(0.6 * low + 0.4 * high, 0.4 * low + 0.6 * high, spacing) for low, high in scene.bounds]
    start = torch.from_numpy(np.stack(np.meshgrid(*axes), axis=-1).reshape(1, -1, scene.dim).astype(np.float32))
    count = start.shape[1]
    material = torch.arange(count)[None] * len(scene.materials) // count
    state = cloud(scene, count=count).with_motion(start, torch.zeros_like(start))
    expected = path_of(emulator, dataclasses.replace(state, material=material), 50)
    assert found.shape == expected.shape
    # By how much particles that come to rest are rounded decides: float32 and float64 part by 0.005 cells there, too.
    same = 8 if name == HELD else 20
    assert apart(emulator, found[:, :same], expected[:, :same]) < 1e-4
    assert apart(emulator, found[:, :20], expected[:, :20]) < 0.02
    assert len([line for line in RUNNER.read_text().splitlines() if line.strip()]) <= 40


@dataclass(frozen=True)
class Deciding(Processor):
    """A network that decides by its data."""

    def build(self, layout: GridLayout) -> GridProcessor:
        inner = Pointwise(hidden=(4,)).build(layout)

        class Decides(GridProcessor):
            def forward(self, grid):
                return inner(grid) if grid.sum() > 0 else inner(-grid)

        return Decides()


def test_what_cannot_be_exported_is_said(tmp_path):
    with pytest.raises(ConfigError, match="do not carry: bounds: error: export with --free"):
        Step(emulator_of(box(), Constraints(bounds="error")))
    write = FORMATS["onnx"].write
    with pytest.raises(ConfigError, match=r"torch\.export cannot follow Deciding"):
        write(Network(emulator_of(box(), processor=Deciding())), {}, tmp_path / "no.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_an_operation_that_onnx_lacks_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"cannot be written as ONNX.*--format pt2"):
        FORMATS["onnx"].write(Step(emulator_of(box(), transfer=Affine())), {}, tmp_path / "no.onnx")
    assert not list(tmp_path.iterdir())


def test_what_is_missing_is_said(tmp_path, monkeypatch):
    part = Network(emulator_of(box()))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r'pip install -e "\.\[export\]"'):
        FORMATS["onnx"].write(part, {}, tmp_path / "no.onnx")
    monkeypatch.setattr(torch._inductor.config.cpp, "cxx", (None, "no-such-compiler"))
    with pytest.raises(ConfigError, match=r"no C\+\+ compiler no-such-compiler.*--format onnx"):
        FORMATS["pt2"].write(part, {}, tmp_path / "no.pt2")


def test_a_zoo_model_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "goop", "--processor"]) == 0
    assert "wrote goop-processor.onnx; largest difference" in capsys.readouterr().out
    about = onnxruntime.InferenceSession("goop-processor.onnx").get_modelmeta().custom_metadata_map
    assert (about["model"], about["part"]) == ("goop", "network")
    assert "simulated by nmpm" in about["training_data"]


def test_a_file_that_differs_from_its_model_is_deleted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    wrong = Format(lambda part, about, path: path.touch(), lambda path, inputs: (torch.ones(1),))
    monkeypatch.setattr(export, "FORMATS", {"onnx": wrong})
    monkeypatch.setattr(Format, "difference", lambda *_, **__: 0.5)
    assert main(["export", "goop", "--processor"]) == 1
    message = "Verification failed: goop-processor.onnx differed from the model by 0.5 cells in one call"
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("*.onnx"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["export", "nothing.ckpt"], "there is no such checkpoint"),
        (["export", "goop", "--format", "pt2", "--out", "goop.onnx"], "its name must end in .pt2"),
        (["export", "goop", "--out", "nowhere/goop.onnx"], "the folder nowhere does not exist"),
        (["export", "goop", "--device", "cuda"], "ONNX files run on any device"),
    ],
)
def test_a_wrong_call_is_said(words, message, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert main(words) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("kind", [Step, Network])
def test_a_part_computes_on_the_device_that_it_is_moved_to(kind, monkeypatch):
    """On torch's meta device, which raises where devices are mixed."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    part = kind(emulator_of(box(materials=("water", "sand")), Constraints(energy=True, solids=False))).to("meta")
    outputs = part(**part.example(2, 7))
    assert {output.device.type for output in outputs} == {"meta"}
    assert [output.shape[0] for output in outputs] == [2] * len(part.outputs)
