"""Particles of different size."""

import numpy as np
import pytest
import torch

from nmpm.data.format import Trajectory, write_metadata, write_split
from nmpm.data.recordings import SplitRecordings
from nmpm.data.windows import collate
from nmpm.errors import DataError
from tests.made_up import made_up_metadata, made_up_trajectory, recordings_of

RADII = [np.array([0.8, 0.8, 0.9, 0.9, 0.9, 0.0]), np.array([0.8, 0.9, 0.8, 0.8, 0.8, 0.8, np.nan])]


def recordings_with(folder, name, values, split="train", dim=2) -> SplitRecordings:
    """Recordings of two trajectories with a field, one value per moving particle, and one for a particle at rest."""
    runs = [made_up_trajectory(12, own.shape[-1] - 1, seed, statics=1, dim=dim) for seed, own in enumerate(values)]
    stored = [
        Trajectory(run.position, run.particle_type, {}, {name: own}) for run, own in zip(runs, values, strict=True)
    ]
    write_split(folder / f"{split}.h5", stored)
    write_metadata(folder, made_up_metadata(dim))
    return recordings_of(folder, split)


@pytest.mark.parametrize(("name", "power"), [("radius", 2), ("diameter", 2), ("size", 2), ("volume", 1)])
def test_sizes_become_volumes_over_their_mean(tmp_path, name, power):
    recordings = recordings_with(tmp_path, name, RADII)
    window = collate([recordings[0], recordings[1]], recordings.reading, 4)
    sizes = [torch.tensor(values[:-1]) ** power for values in RADII]
    mean = torch.cat(sizes).mean()
    torch.testing.assert_close(window.volume[0, :5].double(), sizes[0] / mean, rtol=1e-6, atol=0)
    torch.testing.assert_close(window.volume[1].double(), sizes[1] / mean, rtol=1e-6, atol=0)
    assert window.volume[0, 5] == 1  # padding
    assert torch.cat([window.volume[0, :5], window.volume[1]]).mean() == pytest.approx(1, rel=1e-6)
    assert recordings.reading.scene.fields == ()
    assert torch.equal(window.initial.volume, window.volume)


def test_all_splits_have_the_same_unit(tmp_path):
    recordings_with(tmp_path, "radius", RADII, dim=3)
    test = recordings_with(tmp_path, "radius", [np.full(5, 0.9)] * 2, split="test", dim=3)
    mean = np.concatenate([values[:-1] ** 3 for values in RADII]).mean()
    np.testing.assert_allclose(test[0].volume, np.full(4, 0.9**3 / mean), rtol=1e-6)


def test_particles_that_are_alike_or_grow_have_no_volume(tmp_path):
    assert recordings_with(tmp_path, "radius", [np.linspace(0.8, 0.803, 6)] * 2)[0].volume is None
    growing = np.linspace(0.8, 0.9, 12)[:, None] * np.ones(6)
    assert recordings_with(tmp_path, "radius", [growing])[0].volume is None
    constant = np.broadcast_to(np.array([0.8, 0.8, 0.9, 0.9, 0.9, 0.0]), (12, 6))
    assert recordings_with(tmp_path, "radius", [constant])[0].volume is not None
    with pytest.raises(DataError, match=r"trajectory 00001: the size of particle 3 .* is not a positive number"):
        recordings_with(tmp_path, "radius", [RADII[0], np.array([1.0, 1, 1, -1, 1])])[1]
