"""States and models that rollouts refuse, by name."""

import dataclasses

import pytest
import torch
from scenes import box, cloud

from nmpm.emulator import Emulator, EmulatorRecipe, rollout
from nmpm.emulator.input_checks import check_inputs
from nmpm.errors import DataError
from nmpm.processors import Pointwise
from nmpm.scene import Scene


def emulator_of(scene: Scene, scale: float = 1.0) -> Emulator:
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, 16, 4, processor=Pointwise(hidden=(4,))).build().eval()
    emulator.output_scale.fill_(scale)
    return emulator


def test_inputs_are_checked_in_one_reading(monkeypatch):
    scene = box()
    emulator, particles = emulator_of(scene, 1e-6), cloud(scene)
    read, to_bool = [], torch.Tensor.__bool__
    monkeypatch.setattr(torch.Tensor, "__bool__", lambda values: read.append(values) or to_bool(values))
    check_inputs(emulator, particles)
    assert len(read) == 1


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("gravity", (1, 1), float("nan"), r"Scene 1 of the batch, its gravity is \[.*nan\]; it must be finite"),
        ("gravity", (0, 0), -float("inf"), "Scene 0 of the batch, its gravity"),
        ("obstacle", (1, 4), float("nan"), r"Scene 1 of the batch, obstacle particle 4: its position is \[nan"),
        ("material", (0, 7), 2, r"particle 7: its material is 2; .* the model's 2 \(water, sand\)"),
        ("material", (1, 7), -1, "Scene 1 of the batch, particle 7: its material is -1"),
    ],
)
def test_a_state_that_cannot_be_is_named_unless_it_is_padding(name, place, value, message):
    scene = box(materials=("water", "sand"), obstacles=True)
    particles = cloud(scene, batch=2, statics=6)
    particles = dataclasses.replace(particles, gravity=particles.gravity.clone())
    emulator = emulator_of(scene, 1e-6)
    getattr(particles, name)[place] = value
    with pytest.raises(DataError, match=message):
        check_inputs(emulator, particles)
    if name != "gravity":
        (particles.mask if name == "material" else particles.obstacle_mask)[place] = False
        check_inputs(emulator, particles)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("what", ["position", "velocity"])
def test_what_is_no_number_is_named_and_not_spread(bad, what):
    scene = box()
    particles = cloud(scene, batch=2)
    values = getattr(particles, what).clone()
    values[1, 3, 0] = bad
    poisoned = dataclasses.replace(particles, **{what: values})
    with pytest.raises(DataError, match=f"Scene 1 of the batch, particle 3: its {what} is"):
        rollout(emulator_of(scene), poisoned, 2)


def test_particles_outside_are_named_and_not_clamped():
    scene = box()
    particles = cloud(scene)
    position = particles.position.clone()
    position[0, 5, 1] = 1.5
    with pytest.raises(DataError, match=r"particle 5: it is at .* outside of the domain .* \(1 particles are\)"):
        rollout(emulator_of(scene), particles.with_motion(position, particles.velocity), 2)


def far_away(offset: float) -> Scene:
    return box(bounds=((offset + 0.1, offset + 0.9),) * 2, domain=((offset + 0.08, offset + 0.92),) * 2, gravity=None)


def test_an_origin_too_far_for_float32_is_refused_by_name():
    scene = far_away(1e8)
    particles = cloud(box(gravity=None))
    particles = particles.with_motion(particles.position + 1e8, particles.velocity)
    with pytest.raises(
        DataError, match=r"float32 numbers have a spacing of 8 near 1e\+08.*subtract its lower corner.*float64"
    ):
        rollout(emulator_of(scene), particles, 2)


@pytest.mark.parametrize("where", ["processor", "output_scale"])
def test_a_weight_or_statistic_that_is_no_number_is_named(where):
    scene = box()
    emulator = emulator_of(scene)
    values = next(emulator.processor.parameters()).data if where == "processor" else emulator.output_scale
    values[(0,) * values.dim()] = float("nan")
    with pytest.raises(DataError, match=f"The emulator's {where}.* not finite"):
        rollout(emulator, cloud(scene), 1)
