import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.convert import Options
from nmpm.data.format import Split, read_metadata
from nmpm.data.loading.padded_batch import PaddedRecordings, unwrap
from nmpm.data.loading.recording import SplitRecordings
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import DataError
from nmpm.scene import Scene


def recordings_of(folder, name="train", **arguments) -> SplitRecordings:
    family = arguments.get("family")
    scene = infer_scene(folder, Options(**arguments))
    return SplitRecordings(Split(folder / f"{name}.h5"), read_metadata(folder, family), scene)


def test_separates_static_particles(make_dataset):
    recordings = recordings_of(make_dataset(statics=3))
    recorded, trajectory = recordings[1], recordings.split.read(1)
    np.testing.assert_array_equal(recorded.frames, trajectory.position[:, :7])
    np.testing.assert_array_equal(recorded.obstacle, trajectory.position[0, 7:])
    assert recorded.material.tolist() == [0] * 7


def test_gravity_of_the_trajectory_comes_first(make_dataset):
    folder = make_dataset()
    with h5py.File(folder / "train.h5", "a") as file:
        file["00001"].attrs["gravity"] = [1.0, 0.0]
    torch.testing.assert_close(recordings_of(folder)[1].gravity, torch.tensor([0.0025**2, 0.0]))


def test_a_gravity_that_is_no_vector_is_reported(make_dataset):
    folder, gravity = make_dataset(), [float("nan"), 0.0]
    recordings = recordings_of(folder)
    with h5py.File(folder / "train.h5", "a") as file:
        file["00001"].attrs["gravity"] = gravity
    with pytest.raises(DataError, match=r"trajectory 00001: the attribute gravity = .* should be 2 finite numbers"):
        recordings[1]


def test_positions_outside_the_domain_are_refused(make_dataset):
    folder = make_dataset()
    recordings = recordings_of(folder)
    with h5py.File(folder / "train.h5", "a") as file:
        file["00002/position"][4, 3, 1] = 0.95
    with pytest.raises(DataError, match=r"trajectory 00002: particle 3 in frame 4 is at \[.*0.9\d+\], outside"):
        recordings[2]
    recordings[1]


def test_unknown_material_is_refused(make_dataset):
    folder = make_dataset(particle_types={3: "boundary", 5: "water", 7: "goop"})
    recordings = recordings_of(folder)
    with h5py.File(folder / "train.h5", "a") as file:
        file["00001/particle_type"][0] = 5
    with pytest.raises(DataError, match=r"trajectory 00001: the material 'water' \(type 5\) is not in the scene.*goop"):
        recordings[1]
    with h5py.File(folder / "train.h5", "a") as file:
        file["00001/particle_type"][0] = 8
    with pytest.raises(DataError, match="unknown particle type 8"):
        recordings[1]


def test_padding_of_a_batch(make_dataset):
    recordings = recordings_of(make_dataset(statics=2))
    chosen = [recordings[i] for i in range(3)]
    window = PaddedRecordings.stack(chosen, recordings.scene).gather([0, 1, 2], [0, 3, 6], 5)
    assert window.frames.shape == (3, 5, 7, 2)
    assert window.mask.sum(dim=1).tolist() == [5, 7, 6]
    assert window.obstacle_mask.all()
    for row, start in enumerate([0, 3, 6]):
        count = len(chosen[row].material)
        torch.testing.assert_close(window.frames[row, :, :count], chosen[row].frames[start : start + 5], rtol=0, atol=0)
        torch.testing.assert_close(window.frames[row, :, count:], torch.full((5, 7 - count, 2), 0.5))


PERIODIC = Scene(
    bounds=((0, 2), (-1, 1)),
    domain=((0, 2), (-1, 1)),
    dt=1,
    materials=("fluid",),
    particle_volume=0.1,
    boundary=("periodic", "wall"),
)


@given(seed=st.integers(0, 1000), frames=st.integers(2, 40))
@settings(max_examples=20, deadline=None)
def test_unwrap_inverts_wrapping(seed, frames):
    generator = torch.Generator().manual_seed(seed)
    steps = (torch.rand(2, frames, 5, 2, generator=generator) - 0.5) * 0.9
    path = steps.cumsum(dim=1)
    path[:, 0, :, 0] = path[:, 0, :, 0].remainder(2)
    path[:, 1:, :, 0] = path[:, :1, :, 0] + steps[:, 1:, :, 0].cumsum(dim=1)
    wrapped = path.clone()
    wrapped[..., 0] = wrapped[..., 0].remainder(2)
    unwrap(wrapped, PERIODIC)
    torch.testing.assert_close(wrapped, path, rtol=0, atol=1e-5)
