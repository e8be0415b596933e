import dataclasses
import json

import numpy as np
import pytest
from omegaconf import OmegaConf

from nmpm.errors import ConfigError, DataError
from nmpm.sim import InitialState, load_preset, preset_from_dict
from nmpm.sim.sph.boundary import PolygonObstacle

DAM, WBC = load_preset("dambreak2d"), load_preset("wbcsph")

# The same scenes, coarse and short.
SMALL = dataclasses.replace(
    WBC,
    frames=40,
    substeps=13,
    spacing=0.02,
    blocks=dataclasses.replace(WBC.blocks, particles=(700, 800), gap=0.03),
)


@pytest.mark.parametrize("preset", [DAM, WBC])
def test_round_trip_through_plain_values(preset):
    assert preset_from_dict(json.loads(json.dumps(preset.to_dict()))) == preset


def test_the_dam_break_has_lagrangebenchs_sizes():
    assert DAM.frames == 400
    assert DAM.frame_dt / DAM.substeps == pytest.approx(3e-4)
    assert DAM.max_particles == 5740
    assert DAM.scene.gravity == (0.0, -1.0)
    assert DAM.scene.obstacles
    assert not DAM.scene.gravity_varies


def test_wbcsph_has_the_papers_sizes_and_a_gravity_of_its_own():
    assert WBC.frames == 3200
    assert WBC.blocks.particles[1] == 15000
    assert WBC.scene.gravity is None
    assert WBC.scene.gravity_varies
    assert WBC.type_names == {3: "boundary", 5: "water"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"colour": 1}, "unknown colour"),
        ({"substeps": 40}, "sound: take at least 54"),
        ({"substeps": 12.5}, "substeps"),
        ({"fluid": {**DAM.to_dict()["fluid"], "viscosity": 5.0}}, "viscosity"),
        ({"gravity": [0.0, -1e6]}, "gravity"),
        ({"gravity_turn": 200.0}, "gravity_turn"),
        ({"fluid": {"density": 1.0}}, "fluid: missing"),
        ({"fluid": {**DAM.to_dict()["fluid"], "density": -1.0}}, "density"),
        ({"column": {**DAM.to_dict()["column"], "width": 6.0}}, "does not fit"),
        ({"blocks": WBC.to_dict()["blocks"]}, "either column or blocks"),
        ({"frames": "many"}, "frames"),
        ({"obstacles": {"number": [3, 1], "size": [0.1, 0.2], "gap": 0.0}}, "obstacles.number"),
    ],
)
def test_an_invalid_file_is_refused_naming_the_key(tmp_path, changes, message):
    path = tmp_path / "mine.yaml"
    OmegaConf.save(OmegaConf.create(DAM.to_dict() | changes), path)
    with pytest.raises(ConfigError, match=message) as caught:
        load_preset(path)
    assert str(path) in str(caught.value)


@pytest.fixture(scope="module")
def trajectories():
    return [SMALL.simulate(seed) for seed in range(4)]


def test_no_particle_is_ever_outside_or_in_an_obstacle(trajectories):
    for seed, made in enumerate(trajectories):
        rng = np.random.default_rng(seed)
        rng.uniform()
        obstacles = SMALL.obstacles.draw(SMALL.box, rng)
        water = made.position[:, made.particle_type == 5].reshape(-1, 2).astype(np.float64)
        low, high = np.array(SMALL.box).T
        assert np.all((water >= low) & (water <= high))
        for obstacle in obstacles:
            assert obstacle.depth(water).max() <= 0


def test_trajectories_have_the_frames_and_types_of_their_preset(trajectories):
    for made in trajectories:
        frames, particles, _ = made.position.shape
        assert frames == 41
        assert particles <= SMALL.max_particles
        assert set(made.particle_type) == {3, 5}
        assert np.all(np.ptp(made.position[:, made.particle_type == 3], axis=0) == 0)
        assert made.position.dtype == np.float32
        assert 0 < made.attributes["density_deviation"] < 0.5


def test_gravity_turns_from_trajectory_to_trajectory_and_water_falls_along_it():
    still = dataclasses.replace(SMALL.blocks, speed=0.0)
    falling = dataclasses.replace(SMALL, frames=8, obstacles=None, blocks=still)
    directions = []
    for seed in range(4):
        made = falling.simulate(seed)
        directions.append(made.attributes["gravity"])
        water = made.position[:, made.particle_type == 5].astype(np.float64).mean(axis=1)
        t = 8 * SMALL.frame_dt
        np.testing.assert_allclose(2 * (water[8] - water[0]) / t**2, directions[-1], atol=0.5)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 9.81)
    assert np.linalg.matrix_rank(np.array(directions)) == 2


def test_the_same_seed_gives_the_same_bits(trajectories):
    np.testing.assert_array_equal(SMALL.simulate(2).position, trajectories[2].position)


def test_a_blow_up_names_preset_seed_and_frame():
    wild = dataclasses.replace(SMALL, blocks=dataclasses.replace(SMALL.blocks, speed=200.0))
    with pytest.raises(ConfigError, match=r"Preset wbcsph, seed 1: .*frame \d+"):
        wild.simulate(1)


def test_progress_is_called_after_each_frame():
    seen: list[int] = []
    dataclasses.replace(SMALL, frames=3).simulate(0, seen.append)
    assert seen == [1, 2, 3]


@pytest.mark.parametrize(
    ("position", "velocity", "message"),
    [
        ([[0.5, 0.5], [0.5, 0.99]], [[0, 0], [0, 0]], "Particle 1"),
        ([[0.3, 0.3], [0.61, 0.6]], [[0, 0], [0, 0]], "Particle 1 .*obstacle"),
        ([[np.nan, 0.5]], [[0, 0]], "Particle 0"),
        ([[0.5, 0.5]], [[0, np.inf]], "Particle 0"),
        ([[0.5, 0.5]], [[0, 0], [0, 0]], "shape"),
    ],
)
def test_invalid_states_are_refused(position, velocity, message):
    obstacle = PolygonObstacle(np.array([[0.55, 0.55], [0.7, 0.55], [0.7, 0.7]]))
    with pytest.raises(DataError, match=message):
        SMALL.simulate_from(
            InitialState(np.array(position, float), np.array(velocity, float), obstacles=(obstacle,)), 1
        )
