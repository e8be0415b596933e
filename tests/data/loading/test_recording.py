import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.format import Split, Trajectory, read_metadata, write_split
from nmpm.data.loading.padded_batch import PaddedRecordings, collate, unwrap
from nmpm.data.loading.recording import SplitRecordings
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import DataError
from nmpm.scene import Scene


def recordings_of(folder, name="train", **arguments) -> SplitRecordings:
    family = arguments.get("family")
    scene = infer_scene(folder, **arguments)
    return SplitRecordings(Split(folder / f"{name}.h5"), read_metadata(folder, family), scene)


def test_separates_static_particles(make_dataset):
    recordings = recordings_of(make_dataset(statics=3))
    recorded, trajectory = recordings[1], recordings.split.read(1)
    np.testing.assert_array_equal(recorded.frames, trajectory.position[:, :7])
    np.testing.assert_array_equal(recorded.obstacle, trajectory.position[0, 7:])
    assert recorded.material.tolist() == [0] * 7


def test_gravity_is_per_frame_squared(make_dataset):
    gravity = recordings_of(make_dataset())[0].gravity
    torch.testing.assert_close(gravity, torch.tensor([0.0, -9.81 * 0.0025**2]))


def test_gravity_of_the_trajectory_comes_first(make_dataset):
    folder = make_dataset()
    with h5py.File(folder / "train.h5", "a") as file:
        file["00001"].attrs["gravity"] = [1.0, 0.0]
    torch.testing.assert_close(recordings_of(folder)[1].gravity, torch.tensor([0.0025**2, 0.0]))


@pytest.mark.parametrize("gravity", ["down", [float("nan"), 0.0], [1.0, 0.0, 0.0]])
def test_a_gravity_that_is_no_vector_is_reported(make_dataset, gravity):
    folder = make_dataset()
    recordings = recordings_of(folder)
    with h5py.File(folder / "train.h5", "a") as file:
        file["00001"].attrs["gravity"] = gravity
    with pytest.raises(DataError, match=r"trajectory 00001: the attribute gravity = .* should be 2 finite numbers"):
        recordings[1]


def test_unknown_gravity_is_zero(make_dataset):
    assert recordings_of(make_dataset(gravity=None))[0].gravity.tolist() == [0, 0]


def test_padding_particles_of_a_file_are_dropped(make_dataset):
    folder = make_dataset(particle_types={-1: "padding", 3: "boundary", 7: "goop"})
    with h5py.File(folder / "train.h5", "a") as file:
        file["00000/particle_type"][2] = -1
        file["00000/position"][:, 2] = 1e6
    recordings = recordings_of(folder)
    np.testing.assert_array_equal(recordings[0].frames, recordings.split.read(0).position[:, [0, 1, 3, 4]])


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
@settings(max_examples=50, deadline=None)
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


def test_walls_do_not_wrap():
    frames = torch.tensor([0.0, 0.0, 1.9, 0.9]).reshape(1, 2, 1, 2)
    before = frames.clone()
    unwrap(frames, PERIODIC)
    assert (frames[..., 1] == before[..., 1]).all()
    torch.testing.assert_close(frames[0, 1, 0, 0], torch.tensor(-0.1))


def test_heated_channel_moves_little(recorded):
    recordings = recordings_of(
        recorded / "jaxsph-heated-channel-2d", family="lagrangebench", boundary=("periodic", "wall")
    )
    raw = recordings[0].frames
    window = collate([recordings[0]], recordings.scene)
    assert raw[:, :, 0].diff(dim=0).abs().max() > 0.9
    assert window.frames.diff(dim=1).abs().max() < 0.1
    assert window.frames[..., 0].max() > 1.5
    torch.testing.assert_close(window.frames[0, ..., 0].remainder(1), raw[..., 0].remainder(1), rtol=0, atol=1e-5)
    assert window.obstacle.shape[1] == 306


def test_dimensions_contradict_the_scene(make_dataset):
    recordings = recordings_of(make_dataset())
    path = recordings.split.path.with_name("deep.h5")
    write_split(path, [Trajectory(np.zeros((3, 2, 3)), np.full(2, 7))])
    with pytest.raises(DataError, match="positions have 3 dimensions, the scene has 2"):
        SplitRecordings(Split(path), recordings.reader.metadata, recordings.scene)
