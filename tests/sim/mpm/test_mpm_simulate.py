import dataclasses

import numpy as np
import pytest

from nmpm.errors import ConfigError, DataError
from nmpm.sim import InitialState, load_preset

GOOP = load_preset("goop")


def block(columns: int, rows: int, low: tuple[float, float], preset=GOOP):
    lattice = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
    return np.array(low) + preset.spacing * (lattice + 0.5)


def with_goop(**changes):
    return dataclasses.replace(GOOP, materials=(dataclasses.replace(GOOP.materials[0], **changes),))


def speeds(position):
    """Root mean square speed of each frame, in length per second."""
    velocity = np.diff(position.astype(np.float64), axis=0) / GOOP.frame_dt
    return np.sqrt((velocity**2).sum(-1).mean(-1))


@pytest.fixture(scope="module")
def trajectory():
    return GOOP.simulate(seed=3)


def test_has_the_frames_and_types_of_its_preset(trajectory):
    frames, particles, dim = trajectory.position.shape
    assert (frames, dim) == (401, 2)
    assert 1700 <= particles <= 2000
    assert trajectory.position.dtype == np.float32
    np.testing.assert_array_equal(trajectory.particle_type, np.full(particles, 7))
    assert trajectory.attributes == {"seed": 3, "held_back": 0}


def test_stays_within_the_box(trajectory):
    assert trajectory.position.min() >= 0.1
    assert trajectory.position.max() <= 0.9


def test_falls_then_comes_to_rest(trajectory):
    speed = speeds(trajectory.position)
    assert speed[:150].max() > 1.0
    assert speed[-1] < 0.05
    assert np.mean(speed[300:] ** 2) < 1e-3 * np.mean(speed[:150] ** 2)


def test_is_the_same_for_a_seed_and_another_for_another():
    short = dataclasses.replace(GOOP, frames=5)
    np.testing.assert_array_equal(short.simulate(1).position, short.simulate(1).position)
    assert short.simulate(1).position.shape != short.simulate(2).position.shape


def test_free_fall_is_exact_before_contact():
    position = block(20, 20, (0.4, 0.55))
    made = GOOP.simulate_from(InitialState(position, np.tile([0.4, 0.3], (400, 1))), frames=60)
    t = GOOP.frame_dt * np.arange(61)[:, None, None]
    # Gravity acts at the start of each substep, so that the fall runs ahead by half a substep's worth.
    ahead = t * GOOP.frame_dt / GOOP.substeps / 2
    expected = position + t * np.array([0.4, 0.3]) + (t**2 / 2 + ahead) * np.array(GOOP.gravity)
    np.testing.assert_allclose(made.position, expected, atol=2e-6)


def test_a_heap_at_rest_keeps_its_area():
    made = GOOP.simulate_from(InitialState(block(110, 16, (0.1072, 0.1036)), np.zeros((1760, 2))), frames=300)
    assert speeds(made.position)[-1] < 0.02
    rise = np.percentile(made.position[-1, :, 1], 98) - np.percentile(made.position[0, :, 1], 98)
    sunk = np.percentile(made.position[-1, :, 1], 2) - np.percentile(made.position[0, :, 1], 2)
    assert abs(rise - sunk) < 0.04 * 16 * GOOP.spacing


def test_a_higher_yield_stress_makes_a_higher_and_narrower_heap():
    position, velocity = block(30, 30, (0.4, 0.15)), np.zeros((900, 2))
    soft = with_goop(yield_stress=50.0).simulate_from(InitialState(position, velocity), frames=200).position[-1]
    stiff = with_goop(yield_stress=800.0).simulate_from(InitialState(position, velocity), frames=200).position[-1]
    assert np.percentile(stiff[:, 1], 98) - 0.1 > 1.3 * (np.percentile(soft[:, 1], 98) - 0.1)
    assert np.ptp(stiff[:, 0]) < 0.8 * np.ptp(soft[:, 0])


def test_a_higher_viscosity_spreads_more_slowly():
    position, velocity = block(30, 30, (0.4, 0.12)), np.zeros((900, 2))
    thin = with_goop(viscosity=30.0).simulate_from(InitialState(position, velocity), frames=60).position[-1]
    thick = with_goop(viscosity=300.0).simulate_from(InitialState(position, velocity), frames=60).position[-1]
    assert np.ptp(thick[:, 0]) < 0.9 * np.ptp(thin[:, 0])


def test_coarser_grids_converge_to_the_fine_one():
    position, velocity = block(30, 30, (0.4, 0.3)), np.tile([1.0, 0.0], (900, 1))
    fine = GOOP.simulate_from(InitialState(position, velocity), frames=150).position
    coarse = [
        GOOP.coarsened(factor).simulate_from(InitialState(position, velocity), frames=150) for factor in (2, 4, 8)
    ]
    errors = [np.mean((made.position - fine) ** 2) for made in coarse]
    still = np.mean((fine - fine[0]) ** 2)
    assert errors[0] < errors[1] < errors[2] < still
    assert errors[0] < 0.05 * still
    assert all(made.attributes["held_back"] == 0 for made in coarse)


def test_starts_from_the_very_corner():
    corners = np.array(np.meshgrid([0.1, 0.9], [0.1, 0.9])).T.reshape(-1, 2)
    made = GOOP.simulate_from(InitialState(corners, np.zeros_like(corners)), frames=20)
    assert made.position.min() >= 0.1
    assert made.position.max() <= 0.9


def test_progress_is_called_after_each_frame():
    seen: list[int] = []
    GOOP.simulate_from(InitialState(block(2, 2, (0.4, 0.4)), np.zeros((4, 2))), frames=3, progress=seen.append)
    assert seen == [1, 2, 3]


@pytest.mark.parametrize(
    ("position", "velocity", "message"),
    [
        ([[0.5, 0.5], [0.5, 0.95]], [[0, 0], [0, 0]], "Particle 1 at .0.5, 0.95."),
        ([[np.nan, 0.5]], [[0, 0]], "Particle 0"),
        ([[0.5, 0.5]], [[0, np.inf]], "Particle 0"),
        ([[0.5, 0.5]], [[0, 0], [0, 0]], "shape"),
        ([[0.5, 0.5, 0.5]], [[0, 0, 0]], "shape"),
    ],
)
def test_invalid_states_are_refused(position, velocity, message):
    with pytest.raises(DataError, match=message):
        GOOP.simulate_from(InitialState(np.array(position, float), np.array(velocity, float)), frames=1)


def test_refuses_counts_that_do_not_add_up():
    with pytest.raises(DataError, match="Counts"):
        GOOP.simulate_from(InitialState(np.full((2, 2), 0.5), np.zeros((2, 2)), counts=(1,)), 1)


def test_a_blow_up_names_its_substep():
    position = block(10, 10, (0.4, 0.4))
    velocity = np.where(np.indices(position.shape).sum(0) % 2, 1e200, -1e200)
    with pytest.raises(ConfigError, match=r"not finite after substep \d+ of 12 of frame 1;.*more substeps"):
        GOOP.simulate_from(InitialState(position, velocity), frames=3)
