"""Speeds and gravity of a dataset, as a model is compared with."""

import numpy as np
import pytest

from nmpm.data.format import Trajectory, read_metadata, write_metadata, write_split
from nmpm.data.survey import measure_motion
from tests.made_up import made_up_metadata


def falling(seed: int, gravity: float = -9.81, frames: int = 20) -> Trajectory:
    """Forty particles in free fall, and a boundary particle that rests."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(0.3, 0.7, (1, 41, 2)), np.array([1.0, 0.0])
    time = 0.0025 * np.arange(frames)[:, None, None]
    path = start + velocity * time + np.array([0, gravity / 2]) * time**2
    path[:, -1] = start[:, -1]
    return Trajectory(path.astype(np.float32), np.r_[np.full(40, 7), 3])


@pytest.mark.parametrize("gravity", [(0.0, -9.81), None], ids=["stated", "measured"])
def test_speeds_are_per_frame_and_gravity_is_measured_where_none_is_stated(tmp_path, gravity):
    write_split(tmp_path / "train.h5", [falling(seed) for seed in range(3)])
    write_metadata(tmp_path, made_up_metadata(gravity=gravity))
    motion = measure_motion(tmp_path, read_metadata(tmp_path))
    falls = 9.81 * 0.0025 * (np.arange(19) + 0.5)
    speeds = 0.0025 * np.hypot(1.0, falls)
    assert motion.rms == pytest.approx(np.sqrt((speeds**2).mean()), rel=0.05)
    assert motion.largest == pytest.approx(speeds[-1], rel=0.01)
    assert motion.gravity == pytest.approx((0.0, -9.81), rel=0.02)
    assert motion.frames == 20


def test_of_trajectories_that_differ_in_gravity_it_is_the_root_mean_square(make_dataset):
    folder = make_dataset()
    pulls = [(3.0, 0.0), (0.0, -4.0)]
    runs = [falling(seed) for seed in range(2)]
    for run, pull in zip(runs, pulls, strict=True):
        run.attributes["gravity"] = np.array(pull)
    write_split(folder / "train.h5", runs)
    motion = measure_motion(folder, read_metadata(folder))
    assert motion.gravity == pytest.approx((3 / 2**0.5, 4 / 2**0.5))
