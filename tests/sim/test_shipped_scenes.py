"""What holds for every scene that ships, of whatever method."""

import json
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nmpm.errors import ConfigError, NmpmError
from nmpm.sim import load_preset, preset_from_dict, preset_names
from nmpm.sim.mpm.ramps import distance_to_ramps
from nmpm.sim.preset import BOUNDARY
from tests.data.fuzzing import FUZZ, VALUES, changed, places

MPM = [name for name in preset_names() if load_preset(name).solver == "mls_mpm"]
SIZES = {
    "goop": (2000, 400),
    "waterramps": (2300, 600),
    "sandramps": (3300, 400),
    "multimaterial": (2000, 1000),
    "waterdrop": (1000, 1000),
    "waterdrop-xl": (9000, 1000),
    "dambreak2d": (5000, 400),
    "wbcsph": (15000, 3200),
}


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_round_trips_through_json(name):
    preset = load_preset(name)
    assert preset.name == name
    assert preset_from_dict(json.loads(json.dumps(preset.to_dict()))) == preset


@pytest.mark.parametrize(("name", "particles", "frames"), [(name, *size) for name, size in SIZES.items()])
def test_sizes_are_those_of_the_paper(name, particles, frames):
    preset = load_preset(name)
    assert preset.frames == frames
    most = preset.blocks.particles[1] if name in MPM else preset.layout.max_particles(preset.spacing)
    assert most == particles


@pytest.mark.parametrize("name", MPM)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_first_frames_of_every_mpm_scene_are_valid(name, seed):
    preset = load_preset(name).with_frames(4)
    made = preset.simulate(seed)
    moving, scene = made.particle_type != BOUNDARY, preset.scene
    low, high = np.array(scene.bounds, np.float32).T
    assert made.position.dtype == np.float32
    assert np.all((made.position[:, moving] >= low) & (made.position[:, moving] <= high))
    assert made.position.shape[1] <= preset.max_particles
    assert scene.obstacles == (not moving.all())
    assert np.array_equal(made.position[0, ~moving], made.position[-1, ~moving])
    assert {preset.type_names[kind] for kind in made.particle_type[moving].tolist()} == set(scene.materials)
    np.testing.assert_array_equal(preset.simulate(seed).position, made.position)
    assert not np.array_equal(preset.simulate(seed + 7).position[0, :50], made.position[0, :50])
    fall = np.array(made.attributes.get("gravity", scene.gravity)) * preset.frame_dt**2
    second = np.median(np.diff(made.position[:3, moving].astype(float), n=2, axis=0), axis=(0, 1))
    np.testing.assert_allclose(second, fall, atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_no_particle_gets_into_a_ramp_or_out_of_the_box(seed):
    preset = load_preset("waterramps").with_frames(120)
    start = preset.draw(seed)
    ramps = start.obstacles
    made = preset.simulate(seed)
    moving = made.particle_type != BOUNDARY
    assert distance_to_ramps(ramps, start.position).min() >= preset.ramps.gap
    np.testing.assert_allclose(
        made.position[0, ~moving], np.concatenate([ramp.particles(preset.spacing) for ramp in ramps]), atol=1e-7
    )
    nearest = min(distance_to_ramps(ramps, frame[moving].astype(float)).min() for frame in made.position)
    assert nearest > 0
    assert made.attributes["held_back"] == 0


@pytest.mark.parametrize("name", ["waterramps", "sandramps", "variablegravity"])
def test_no_seed_is_left_without_a_scene(name):
    preset = load_preset(name)
    drawn = [preset.draw(seed).obstacles for seed in (*range(150), 679165439898320322)]
    assert {len(ramps) for ramps in drawn} == set(range(preset.ramps.number[0], preset.ramps.number[1] + 1))


def test_no_seed_is_left_without_obstacles():
    preset = load_preset("wbcsph")
    drawn = [preset.obstacles.draw(preset.box, np.random.default_rng(seed)) for seed in range(300)]
    assert {len(obstacles) for obstacles in drawn} == {1, 2, 3, 4}


def test_gravity_turns_from_trajectory_to_trajectory():
    preset = load_preset("variablegravity").with_frames(1)
    drawn = np.array([preset.simulate(seed).attributes["gravity"] for seed in range(6)])
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 9.81)
    assert len(np.unique(drawn.round(6), axis=0)) == 6
    assert preset.scene.gravity is None
    assert preset.scene.gravity_varies


def test_every_material_is_in_every_scene_of_several():
    preset = load_preset("multimaterial").with_frames(1)
    for seed in range(5):
        assert set(preset.simulate(seed).particle_type.tolist()) == {5, 6, 7}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gravity_turn": 200.0}, "gravity_turn"),
        ({"gravity": [0.0, 0.0, -9.81]}, "gravity = .* needs 2 entries"),
        ({"box": [[0.1, 0.9]]}, "1 axes; 2 or 3"),
    ],
)
def test_invalid_values_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        preset_from_dict(load_preset("waterramps").to_dict() | changes)


@pytest.mark.parametrize("name", ["../../../x", "a/b", "..", ".x", "", "a\n", "${oc.env:HOME}", 3, ["goop"]])
def test_a_name_leads_to_no_other_folder(name):
    with pytest.raises(ConfigError, match="name = ") as caught:
        preset_from_dict(load_preset("goop").to_dict() | {"name": name})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["waterramps", "wbcsph"])
def test_any_value_anywhere_in_a_preset(name):
    plain = load_preset(name).to_dict()
    where = sorted(places(plain), key=str)

    @FUZZ
    @given(st.sampled_from(where), VALUES)
    def check(place, value):
        with suppress(NmpmError):
            preset = preset_from_dict(changed(plain, place, value))
            assert preset.scene.dim == len(preset.box)

    check()
