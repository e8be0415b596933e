"""What holds for every shipped preset of every solver, and what is refused."""

import dataclasses
import json
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from nmpm.errors import ConfigError, DataError, NmpmError
from nmpm.sim import InitialState, load_preset, name_parts, preset_from_dict, preset_names
from nmpm.sim.mpm.layouts import SimulatedRamp, distance_to_ramps
from nmpm.sim.preset import BOUNDARY
from nmpm.sim.sph.boundary import PolygonObstacle
from tests.data.fuzzing import FUZZ, VALUES, changed, places

NAMES = preset_names()
# The column of dambreak2d takes seconds to draw; its layout is tested in sph/test_boundary.py.
QUICK = [name for name in NAMES if name != "dambreak2d"]
GOOP, DAM, WBC = (load_preset(name) for name in ("goop", "dambreak2d", "wbcsph"))
SIZES = {
    "goop": (2000, 400), "waterramps": (2300, 600), "sandramps": (3300, 400), "multimaterial": (2000, 1000),
    "waterdrop": (1000, 1000), "waterdrop-xl": (9000, 1000), "dambreak2d": (5000, 400), "wbcsph": (15000, 3200),
}  # fmt: skip


def small(name):
    """A preset that simulates a frame in milliseconds."""
    preset = load_preset(name)
    return preset.coarsened(4) if preset.solver == "wcsph" else preset


@pytest.mark.parametrize("name", NAMES)
def test_presets_round_trip_and_have_the_papers_sizes(name):
    preset = load_preset(name)
    assert preset.name == name
    assert preset_from_dict(json.loads(json.dumps(preset.to_dict()))) == preset
    assert preset.substeps >= preset.stable_substeps
    if name in SIZES:
        most = preset.blocks.particles[1] if preset.blocks else preset.column.width * preset.column.height / 0.02**2
        assert (most, preset.frames) == SIZES[name]


def test_mixtures_name_the_parts_that_are_shipped_presets():
    plain = load_preset("universal").to_dict()
    short = name_parts(plain)
    assert [part["preset"] for part in short["parts"][:2]] == ["multimaterial", "sandramps"]
    assert preset_from_dict(json.loads(json.dumps(short))).to_dict() == plain
    slower = plain["parts"][0]["preset"] | {"frame_dt": 0.005}
    assert name_parts({"parts": [{"preset": slower}, "?"]}) == {"parts": [{"preset": slower}, "?"]}
    assert name_parts(GOOP.to_dict()) == GOOP.to_dict()


def test_scenes_state_the_facts():
    scene = GOOP.scene
    assert (scene.bounds, scene.domain) == (GOOP.box, ((0.08, 0.92), (0.08, 0.92)))
    assert (scene.materials, scene.gravity, scene.particle_volume) == (("goop",), (0.0, -9.81), GOOP.spacing**2)
    assert (DAM.scene.gravity, DAM.scene.obstacles, DAM.max_particles) == ((0.0, -1.0), True, 5740)
    assert (WBC.scene.gravity, WBC.scene.gravity_varies) == (None, True)
    assert WBC.type_names == {3: "boundary", 5: "water"}


@pytest.mark.parametrize("name", QUICK)
def test_the_first_frames_of_every_scene_are_valid(name):
    preset = small(name).with_frames(3)
    frames: list[int] = []
    start, made = preset.draw(5), preset.simulate(5, frames.append)
    again = preset.simulate_from(start, 3)
    np.testing.assert_array_equal(made.position, again.position)
    np.testing.assert_array_equal(made.particle_type, again.particle_type)
    assert made.attributes.keys() - again.attributes.keys() == {"seed"}
    assert frames == [1, 2, 3]
    moving, scene = made.particle_type != BOUNDARY, preset.scene
    low, high = np.array(scene.bounds, np.float32).T
    assert made.position.dtype == np.float32
    assert np.all((made.position[:, moving] >= low) & (made.position[:, moving] <= high))
    assert sum(start.counts) == moving.sum()
    assert made.position.shape[1] <= preset.max_particles
    assert scene.obstacles == (not moving.all())
    np.testing.assert_allclose(made.position[0, moving], start.position, atol=1e-6)
    assert np.array_equal(made.position[0, ~moving], made.position[-1, ~moving])
    kinds = {preset.type_names[kind] for kind in made.particle_type[moving].tolist()}
    assert kinds == set(scene.materials) or (preset.solver == "mls_mpm_mixture" and kinds < set(scene.materials))
    fall = np.array(made.attributes.get("gravity", scene.gravity)) * preset.frame_dt**2
    second = np.median(np.diff(made.position[:3, moving].astype(float), n=2, axis=0), axis=(0, 1))
    np.testing.assert_allclose(second, fall, atol=2e-6 if preset.solver == "wcsph" else 1e-7)


@pytest.mark.parametrize("name", QUICK)
def test_variation_scales_initial_velocities_and_gravity_alone(name):
    preset = small(name)
    start, varied = preset.draw(2), preset.varied(speed=3.0, gravity=-0.5).draw(2)
    np.testing.assert_array_equal(varied.position, start.position)
    np.testing.assert_allclose(varied.velocity, 3.0 * start.velocity, rtol=1e-12)
    np.testing.assert_allclose(varied.gravity, -0.5 * np.array(start.gravity), rtol=1e-12)
    assert preset.varied() == preset


@pytest.mark.parametrize("name", NAMES)
def test_a_wider_domain_keeps_the_wall_and_holds_more(name):
    """Rounding must not part box and domain: a model of scenes without walls could not run there."""
    preset = small(name)
    (left, right), (box_left, box_right) = preset.domain[0], preset.box[0]
    for times in (2, 3, 7, 32):
        wide = preset.widened(times)
        assert wide.domain[0] == (left, pytest.approx(left + times * (right - left)))
        assert (wide.domain[1:], wide.box[0][0], wide.substeps) == (preset.domain[1:], box_left, preset.substeps)
        assert wide.domain[0][1] - wide.box[0][1] >= right - box_right - 1e-9
        assert wide.scene.walled == preset.scene.walled, times
        assert wide.scene.input_channels == preset.scene.input_channels, times
        assert wide.max_particles <= (times + 0.1) * preset.max_particles
    made = preset.widened(2).with_frames(1).simulate(0)
    assert made.position.shape[1] <= preset.widened(2).max_particles
    assert made.position[0, made.particle_type != BOUNDARY, 0].max() > box_left


def test_coarsening_keeps_the_particles_and_needs_whole_cells():
    coarse = GOOP.coarsened(4)
    assert coarse.cell_size == pytest.approx(4 * GOOP.cell_size)
    assert (coarse.spacing, coarse.substeps) == (GOOP.spacing, coarse.stable_substeps)
    np.testing.assert_array_equal(coarse.draw(3).position, GOOP.draw(3).position)
    with pytest.raises(ConfigError, match="3 times"):
        GOOP.coarsened(3)


def test_no_particle_gets_into_a_ramp_or_out_of_the_box():
    preset = load_preset("waterramps").with_frames(80)
    start, made = preset.draw(0), preset.simulate(0)
    ramps = start.obstacles
    moving = made.particle_type != BOUNDARY
    assert distance_to_ramps(ramps, start.position).min() >= preset.ramps.gap
    np.testing.assert_allclose(
        made.position[0, ~moving], np.concatenate([ramp.particles(preset.spacing) for ramp in ramps]), atol=1e-7
    )
    nearest = min(distance_to_ramps(ramps, frame[moving].astype(float)).min() for frame in made.position)
    assert nearest > 0
    assert made.attributes["held_back"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["waterramps", "sandramps", "variablegravity"])
def test_no_seed_is_left_without_a_scene(name):
    preset = load_preset(name)
    drawn = [preset.draw(seed) for seed in (*range(100), 679165439898320322)]
    numbers = range(preset.ramps.number[0], preset.ramps.number[1] + 1)
    assert {len(start.obstacles) for start in drawn} == set(numbers)
    if preset.gravity_turn:
        gravity = np.array([start.gravity for start in drawn])
        np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 9.81)
        assert len(np.unique(gravity.round(6), axis=0)) == len(drawn)


BLOCKS, FLUID = GOOP.to_dict()["blocks"], DAM.to_dict()["fluid"]


@pytest.mark.parametrize(
    ("preset", "changes", "message"),
    [
        (GOOP, {"colour": 1}, "unknown colour"),
        (GOOP, {"name": "../../../x"}, "name = "),
        (GOOP, {"substeps": 1}, "too few.*at least 6"),
        (GOOP, {"substeps": 12.5}, "substeps"),
        (GOOP, {"box": [[0.1, 0.9], [0.1, 0.85001]]}, "whole number"),
        (GOOP, {"gravity": [0.0, 0.0, -9.81]}, "gravity = .* needs 2 entries"),
        (GOOP, {"materials": {"treacle": {}}}, "treacle.*goop"),
        (GOOP, {"materials": {"goop": {"density": 1.0}}}, "materials.goop.*missing"),
        (GOOP, {"blocks": {**BLOCKS, "number": [3, 1]}}, "blocks.number"),
        (load_preset("waterdrop3d"), {"walls": "slip, open corners"}, "implemented in two dimensions"),
        (DAM, {"substeps": 40}, "sound: take at least 54"),
        (DAM, {"fluid": {**FLUID, "density": -1.0}}, "density"),
        (DAM, {"column": {**DAM.to_dict()["column"], "width": 6.0}}, "does not fit"),
        (DAM, {"blocks": WBC.to_dict()["blocks"]}, "either column or blocks"),
        (DAM, {"obstacles": {"number": [3, 1], "size": [0.1, 0.2], "gap": 0.0}}, "obstacles.number"),
    ],
)
def test_an_invalid_file_is_refused_naming_the_key(tmp_path, preset, changes, message):
    path = tmp_path / "mine.yaml"
    OmegaConf.save(OmegaConf.create(preset.to_dict() | changes), path)
    with pytest.raises(ConfigError, match=message) as caught:
        load_preset(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("preset", [GOOP, WBC], ids=["mpm", "sph"])
@pytest.mark.parametrize(
    ("position", "velocity", "message"),
    [
        ([[0.5, 0.5], [0.5, 0.99]], [[0, 0], [0, 0]], "Particle 1 at .0.5, 0.99."),
        ([[0.5, 0.5]], [[0, np.inf]], "Particle 0"),
        ([[0.5, 0.5]], [[0, 0], [0, 0]], "shape"),
        (np.empty((0, 2)), np.empty((0, 2)), "no particle to simulate"),
    ],
)
def test_invalid_states_are_refused(preset, position, velocity, message):
    with pytest.raises(DataError, match=message):
        preset.simulate_from(InitialState(np.array(position, float), np.array(velocity, float)), frames=1)


def test_counts_and_obstacles_must_fit_the_solver():
    low = np.array([0.2, 0.2])
    triangle = PolygonObstacle(low + 0.1 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    bar = SimulatedRamp((0.3, 0.3), 0.2, 0.03, 0.5)
    one = InitialState(np.full((1, 2), 0.7), np.zeros((1, 2)))
    for preset, obstacle in ((load_preset("waterramps"), triangle), (WBC, bar)):
        with pytest.raises(DataError, match="not implemented"):
            preset.simulate_from(dataclasses.replace(one, obstacles=(obstacle,)), 1)
        with pytest.raises(DataError, match="Counts"):
            preset.simulate_from(dataclasses.replace(one, counts=(2,)), 1)
    with pytest.raises(DataError, match=r"Particle 0 .*obstacle"):
        WBC.simulate_from(dataclasses.replace(one, position=low[None] + 0.02, obstacles=(triangle,)), 1)


def test_a_blow_up_names_preset_seed_frame_and_substep():
    wild = dataclasses.replace(GOOP, blocks=dataclasses.replace(GOOP.blocks, speed=1e200), substeps=2**9)
    message = r"Preset goop, seed 1: .*not finite after substep \d+ of 512 of frame 1;.*more substeps"
    with pytest.raises(ConfigError, match=message), np.errstate(all="ignore"):
        wild.simulate(1)
    wild = small("wbcsph")
    wild = dataclasses.replace(wild, blocks=dataclasses.replace(wild.blocks, speed=200.0))
    with pytest.raises(ConfigError, match=r"Preset wbcsph, seed 1: .*frame \d+"):
        wild.simulate(1)


@pytest.mark.slow
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
