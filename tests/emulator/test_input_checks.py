"""States and models that rollouts refuse, by name."""

import dataclasses

import pytest
import torch

from nmpm.emulator import rollout
from nmpm.emulator.monitor import check_inputs
from nmpm.errors import DataError
from tests.scenes import box, cloud, emulator_of


def test_inputs_are_checked_in_one_reading(monkeypatch):
    emulator, particles, read, to_bool = emulator_of(box()), cloud(box()), [], torch.Tensor.__bool__
    monkeypatch.setattr(torch.Tensor, "__bool__", lambda values: read.append(values) or to_bool(values))
    check_inputs(emulator, particles)
    assert len(read) == 1


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("gravity", (1, 1), float("nan"), r"Scene 1 of the batch, its gravity is \[.*nan\]; it must be finite"),
        ("obstacle", (1, 4), float("nan"), r"Scene 1 of the batch, obstacle particle 4: its position is \[nan"),
        ("material", (0, 7), 2, r"particle 7: its material is 2; .* the model's 2 \(water, sand\)"),
        ("material", (1, 7), -1, "Scene 1 of the batch, particle 7: its material is -1"),
        ("position", (1, 3, 0), float("nan"), "Scene 1 of the batch, particle 3: its position is"),
        ("velocity", (1, 3, 0), -float("inf"), "Scene 1 of the batch, particle 3: its velocity is"),
        ("position", (0, 5, 1), 1.5, r"particle 5: it is at .* outside of the domain .* \(1 particles are\)"),
    ],
)
def test_a_state_that_cannot_be_is_named_unless_it_is_padding(name, place, value, message):
    scene = box(materials=("water", "sand"), obstacles=True)
    particles = cloud(scene, batch=2, statics=6)
    particles = dataclasses.replace(particles, gravity=particles.gravity.clone())
    getattr(particles, name)[place] = value
    with pytest.raises(DataError, match=message):
        rollout(emulator_of(scene), particles, 2)
    if name != "gravity":
        (particles.obstacle_mask if name == "obstacle" else particles.mask)[place[:2]] = False
        check_inputs(emulator_of(scene), particles)


def test_an_origin_too_far_for_float32_is_refused_by_name():
    scene = box(bounds=((1e8 + 0.1, 1e8 + 0.9),) * 2, domain=((1e8 + 0.08, 1e8 + 0.92),) * 2, gravity=None)
    particles = cloud(box(gravity=None))
    particles = particles.with_motion(particles.position + 1e8, particles.velocity)
    message = r"float32 numbers have a spacing of 8 near 1e\+08.*subtract its lower corner.*float64"
    with pytest.raises(DataError, match=message):
        rollout(emulator_of(scene), particles, 2)


@pytest.mark.parametrize("where", ["processor", "output_scale"])
def test_a_weight_or_statistic_that_is_no_number_is_named(where):
    emulator = emulator_of(box())
    values = next(emulator.processor.parameters()).data if where == "processor" else emulator.output_scale
    values[(0,) * values.dim()] = float("nan")
    with pytest.raises(DataError, match=f"The emulator's {where}.* not finite"):
        rollout(emulator, cloud(box()), 1)
