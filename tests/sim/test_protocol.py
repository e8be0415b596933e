"""What `Preset` promises, for every shipped preset of every solver."""

import dataclasses

import numpy as np
import pytest

from nmpm.errors import ConfigError, DataError
from nmpm.sim import InitialState, load_preset, preset_names
from nmpm.sim.mpm.ramps import Ramp
from nmpm.sim.preset import BOUNDARY
from nmpm.sim.sph.boundary import PolygonObstacle

NAMES = preset_names()
# The column of dambreak2d takes seconds to draw; its layout is tested in sph/test_layouts.py.
QUICK = [name for name in NAMES if name != "dambreak2d"]


def small(name):
    """A preset that simulates a frame in milliseconds."""
    preset = load_preset(name)
    return preset.coarsened(4) if preset.solver == "wcsph" else preset


@pytest.mark.parametrize("name", NAMES)
def test_simulating_a_seed_is_simulating_from_its_drawn_state(name):
    preset = small(name).with_frames(2)
    start = preset.draw(5)
    made, again = preset.simulate(5), preset.simulate_from(start, 2)
    np.testing.assert_array_equal(made.position, again.position)
    np.testing.assert_array_equal(made.particle_type, again.particle_type)
    assert made.attributes.keys() - again.attributes.keys() == {"seed"}
    moving = made.particle_type != BOUNDARY
    assert sum(start.counts) == moving.sum()
    np.testing.assert_allclose(made.position[0, moving], start.position, atol=1e-6)


@pytest.mark.parametrize("name", QUICK)
def test_a_nudged_state_is_simulated_beside_its_original(name):
    preset = small(name)
    start = preset.draw(0)
    nudged = dataclasses.replace(start, position=start.position + 1e-6)
    first, second = (preset.simulate_from(state, 3) for state in (start, nudged))
    np.testing.assert_array_equal(first.particle_type, second.particle_type)
    apart = np.abs(first.position - second.position).max()
    assert 0 < apart < 1e-4


@pytest.mark.parametrize("name", QUICK)
def test_variation_scales_initial_velocities_and_gravity_alone(name):
    preset = small(name)
    start, varied = preset.draw(2), preset.varied(speed=3.0, gravity=-0.5).draw(2)
    np.testing.assert_array_equal(varied.position, start.position)
    np.testing.assert_allclose(varied.velocity, 3.0 * start.velocity, rtol=1e-12)
    np.testing.assert_allclose(varied.gravity, -0.5 * np.array(start.gravity), rtol=1e-12)
    assert preset.varied() == preset


def test_a_much_faster_scene_takes_more_substeps_and_stays_stable():
    preset = load_preset("waterramps")
    fast = preset.varied(speed=10.0)
    assert fast.substeps == fast.stable_substeps > preset.substeps
    made = fast.with_frames(60).simulate(0)
    speeds = np.linalg.norm(np.diff(made.position, axis=0), axis=-1) / preset.frame_dt
    assert speeds.max() < 2 * np.sqrt(2 * 30.0**2)


def test_without_gravity_and_speed_nothing_moves():
    for name in ("goop", "wbcsph"):
        made = small(name).varied(speed=0.0, gravity=0.0).with_frames(4).simulate(1)
        assert np.abs(made.position[-1] - made.position[0]).max() < 1e-6


def test_a_column_of_fluid_rises_under_reversed_gravity():
    preset = load_preset("dambreak2d").coarsened(4).varied(gravity=-1.0).with_frames(20)
    made = preset.simulate(0)
    height = made.position[:, made.particle_type != BOUNDARY, 1].astype(float).mean(axis=1)
    assert made.attributes["gravity"].tolist() == [0.0, 1.0]
    assert height[-1] - height[0] > 0.1 * (20 * preset.frame_dt) ** 2 / 2


@pytest.mark.parametrize("name", NAMES)
def test_a_wider_domain_keeps_the_wall_and_holds_more(name):
    preset = small(name)
    wide = preset.widened(3)
    (left, right), (box_left, box_right) = preset.domain[0], preset.box[0]
    assert wide.domain[0] == (left, pytest.approx(left + 3 * (right - left)))
    assert wide.domain[1:] == preset.domain[1:]
    assert wide.box[0][0] == box_left
    assert wide.domain[0][1] - wide.box[0][1] >= right - box_right - 1e-9
    assert wide.substeps == preset.substeps
    assert 2 * preset.max_particles < wide.max_particles <= 3.1 * preset.max_particles or preset.scene.obstacles
    made = wide.with_frames(1).simulate(0)
    assert made.position.shape[1] <= wide.max_particles
    assert made.position[0, made.particle_type != BOUNDARY, 0].max() > box_left


@pytest.mark.parametrize("name", NAMES)
def test_a_wider_domain_has_a_wall_layer_where_its_preset_has_one(name):
    """Rounding must not part box and domain: a model of scenes without walls could not run there."""
    preset = load_preset(name)
    for times in range(2, 33):
        wide = preset.widened(times).scene
        assert wide.walled == preset.scene.walled, times
        assert wide.input_channels == preset.scene.input_channels, times


def test_a_wide_dam_break_has_as_many_times_as_many_particles():
    preset = load_preset("dambreak2d").coarsened(4)
    assert preset.widened(2).draw(0).counts[0] == 2 * preset.draw(0).counts[0]


@pytest.mark.parametrize("name", NAMES)
def test_a_state_without_particles_is_refused(name):
    preset = small(name)
    none = np.empty((0, len(preset.box)))
    with pytest.raises(DataError, match="no particle to simulate"):
        preset.simulate_from(InitialState(none, none), 1)


@pytest.mark.parametrize("name", ["waterramps", "wbcsph"])
def test_a_state_of_another_solver_is_refused(name):
    preset = load_preset(name)
    low = np.array(preset.box)[:, 0]
    others = {
        "waterramps": PolygonObstacle(low + 0.2 + 0.1 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])),
        "wbcsph": Ramp((0.3, 0.3), 0.2, 0.03, 0.5),
    }
    start = InitialState(np.full((1, 2), 0.7), np.zeros((1, 2)), obstacles=(others[name],))
    with pytest.raises(DataError, match="not implemented"):
        preset.simulate_from(start, 1)


def test_distances_from_polygons_are_negative_inside():
    square = PolygonObstacle(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
    np.testing.assert_allclose(square.distance(np.array([[0.5, 0.6], [0.5, 1.25]])), [-0.4, 0.25])


@pytest.mark.parametrize("frames", [0, 2.5, -1])
def test_the_number_of_frames_is_checked(frames):
    with pytest.raises(ConfigError, match="frames"):
        load_preset("goop").with_frames(frames)
