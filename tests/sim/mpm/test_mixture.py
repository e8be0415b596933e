"""Mixtures of presets: each trajectory from one of them, as it is or varied, recorded in one domain and time step."""

import dataclasses

import numpy as np
import pytest

from nmpm.data.format import Trajectory
from nmpm.data.recordings import RecordingReader
from nmpm.data.simulation import preset_metadata
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Reading
from nmpm.sim import InitialState, load_preset, preset_from_dict
from nmpm.sim.preset import BOUNDARY, twin_of

UNIVERSAL = load_preset("universal")
STARTS = [UNIVERSAL.draw(seed) for seed in range(12)]


def of_parts(*names, share):
    """The mixture with some of its parts and a share of varied trajectories."""
    parts = tuple(part for part in UNIVERSAL.parts if part.preset.name in names)
    return dataclasses.replace(UNIVERSAL, parts=parts, variation=dataclasses.replace(UNIVERSAL.variation, share=share))


@pytest.mark.parametrize("name", ["sandramps", "goop", "multimaterial"])
def test_what_is_not_varied_is_as_its_part_has_it(name):
    part, start = load_preset(name), of_parts(name, share=0.0).draw(1)
    variant = start.variant
    np.testing.assert_allclose(variant.box, part.box, atol=1e-12)
    assert (variant.cells, start.time, start.gravity) == (part.cells, 1.0, part.gravity)
    assert (variant.spacing, variant.substeps) == (pytest.approx(part.spacing), pytest.approx(part.substeps, abs=6))
    assert (variant.blocks, variant.ramps, variant.materials) == (part.blocks, part.ramps, part.materials)
    # Walls that leave no layer within the mixture's box are the scene's; others are recorded.
    assert (len(start.static) > 0) == (name != "multimaterial")


def test_variation_reaches_all_that_it_names():
    drawn = [of_parts("sandramps", "multimaterial", share=1.0).draw(seed) for seed in range(24)]
    cell = 0.84 / 48
    per_cell = [(cell / start.variant.spacing) ** 2 for start in drawn]
    fall = np.array([start.gravity for start in drawn])
    size = np.linalg.norm(fall, axis=1) * UNIVERSAL.frame_dt**2 / cell
    assert 0.9 < min(per_cell) < 1.6
    assert 5 < max(per_cell) < 9.5
    assert 0 <= min(size) < 0.0015
    assert 0.006 < max(size) < 0.0101
    assert 0.4 < np.mean(fall[:, 0] == 0) < 0.8
    assert {0, 1} < {len(start.obstacles) for start in drawn}
    assert all(start.variant.substeps >= start.variant.stable_substeps for start in drawn)
    assert max(len(start.position) for start in drawn) <= 3000


@pytest.mark.parametrize("start", STARTS, ids=range(len(STARTS)))
def test_walls_within_the_box_are_recorded_and_particles_keep_clear_of_them(start):
    low, high = np.array(start.variant.reach).T
    assert np.all((start.position > low) & (start.position < high))
    beyond = ((start.static < low) | (start.static > high)).any(1)
    room = np.prod([b - a for a, b in UNIVERSAL.box]) - np.prod(high - low)
    assert beyond.sum() * UNIVERSAL.spacing**2 == pytest.approx(room, rel=0.45, abs=0.01)


def test_another_time_between_frames_is_the_same_motion_recorded_more_seldom():
    start = of_parts("waterramps", share=0.0).draw(3)
    slower = dataclasses.replace(
        start,
        velocity=2 * start.velocity,
        gravity=tuple(4 * pull for pull in start.gravity),
        time=2.0,
        variant=dataclasses.replace(start.variant, frame_dt=2 * start.variant.frame_dt, substeps=50),
    )
    usual, other = UNIVERSAL.simulate_from(start, 20), UNIVERSAL.simulate_from(slower, 10)
    np.testing.assert_array_equal(usual.position[::2], other.position)
    np.testing.assert_allclose(other.attributes["gravity"], [0.0, -4 * 9.81])


def test_trajectories_are_read_with_their_own_volume():
    start = next(start for start in STARTS if start.time != 1.0)
    made = UNIVERSAL.simulate_from(start, 4)
    assert np.ptp(made.position[:, made.particle_type == BOUNDARY], axis=0).max() == 0
    reader = RecordingReader(preset_metadata(UNIVERSAL), Reading(UNIVERSAL.scene))
    recording = reader.recording(Trajectory(made.position, made.particle_type, made.attributes), "here")
    np.testing.assert_allclose(recording.volume, (start.variant.spacing / UNIVERSAL.spacing) ** 2, rtol=1e-6)
    np.testing.assert_allclose(recording.gravity, np.array(start.gravity) * UNIVERSAL.frame_dt**2, rtol=1e-6)
    wrong = Trajectory(made.position, made.particle_type, made.attributes | {"particle_volume": -1.0})
    with pytest.raises(DataError, match=r"here: the attribute particle_volume = -1\.0 should be a positive number"):
        reader.recording(wrong, "here")


def test_a_coarser_simulator_starts_from_the_same_states():
    coarse = UNIVERSAL.coarsened(4)
    np.testing.assert_array_equal(coarse.draw(3).position, STARTS[3].position)
    made = coarse.simulate_from(coarse.draw(3), 2)
    np.testing.assert_array_equal(made.position[0], UNIVERSAL.simulate_from(STARTS[3], 2).position[0])
    with pytest.raises(ConfigError, match="3 times"):
        UNIVERSAL.coarsened(3)


def test_other_states_and_parts_are_refused():
    with pytest.raises(DataError, match="only states that it has drawn"):
        UNIVERSAL.simulate_from(InitialState(np.full((1, 2), 0.5), np.zeros((1, 2))), 1)
    plain = UNIVERSAL.to_dict()
    for parts, message in (
        ([{"share": 1.0, "preset": "waterdrop3d"}], "two dimensions"),
        ([{"share": 1.0, "preset": "wbcsph"}], "unknown"),
        ([{"share": 1.0, "preset": "sandramp"}], "no preset or file sandramp.*sandramps"),
        ([{"share": -1.0, "preset": "goop"}], "share = -1.0 must be positive"),
        ([{"share": 1.0, "preset": 3}], "preset = 3 should be"),
        ([], "parts is empty"),
        (3, "parts must list"),
    ):
        with pytest.raises(ConfigError, match=message):
            preset_from_dict(plain | {"parts": parts})


def test_a_mixture_of_fewer_substeps_simulates_with_fewer():
    mixture = of_parts("goop", share=0.0)
    start = mixture.draw(1)
    usual, twin = (each.simulate_from(start, 60).position for each in (mixture, twin_of(mixture)))
    assert 0 < np.abs(usual - twin).max() < 0.05
