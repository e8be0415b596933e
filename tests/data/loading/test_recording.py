import dataclasses
import warnings

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.recordings import SplitRecordings
from nmpm.data.windows import unwrap
from nmpm.errors import DataError
from nmpm.scene import Reading, Scene
from tests.made_up import recordings_of


def test_static_particles_are_separated(make_dataset):
    recordings = recordings_of(make_dataset(statics=3))
    recorded, trajectory = recordings[1], recordings.split.read(1)
    np.testing.assert_array_equal(recorded.frames, trajectory.position[:, :7])
    np.testing.assert_array_equal(recorded.obstacle, trajectory.position[0, 7:])
    assert recorded.material.tolist() == [0] * 7
    assert len(list(recordings)) == 3  # iteration ends after the last


def test_gravity_of_the_trajectory_comes_first(make_dataset):
    folder = make_dataset()
    with h5py.File(folder / "train.h5", "a") as file:
        file["00001"].attrs["gravity"] = [1.0, 0.0]
    torch.testing.assert_close(recordings_of(folder)[1].gravity, torch.tensor([0.0025**2, 0.0]))


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("position", ((4, 3, 1), 0.95), r"particle 3 in frame 4 is at \[.*0.9\d+\], outside"),
        ("position", ((4, 7, 0), 0.5), r"particle 7 is of the static type 3 \(boundary\) but moves"),
        ("particle_type", (0, 5), r"the material 'water' \(type 5\) is not in the scene.*goop"),
        ("particle_type", (0, 8), "unknown particle type 8"),
        ("gravity", [float("nan"), 0.0], "the attribute gravity = .* should be 2 finite numbers"),
    ],
    ids=["outside", "moving wall", "material", "type", "gravity"],
)
def test_trajectories_that_do_not_fit_the_scene_are_named(make_dataset, place, value, message):
    folder = make_dataset(statics=1, particle_types={3: "boundary", 5: "water", 7: "goop"})
    recordings = recordings_of(folder)
    with h5py.File(folder / "train.h5", "a") as file:
        if place == "gravity":
            file["00001"].attrs[place] = value
        else:
            file["00001"][place][value[0]] = value[1]
    with pytest.raises(DataError, match=f"trajectory 00001: {message}"):
        recordings[1]
    recordings[2]


@given(seed=st.integers(0, 1000), frames=st.integers(2, 40))
@settings(max_examples=10, deadline=None)
def test_unwrap_inverts_wrapping(seed, frames):
    box = ((0, 2), (-1, 1))
    scene = Scene(box, box, dt=1, materials=("fluid",), particle_volume=0.1, boundary=("periodic", "wall"))
    generator = torch.Generator().manual_seed(seed)
    path = ((torch.rand(2, frames, 5, 2, generator=generator) - 0.5) * 0.9).cumsum(dim=1)
    path[..., 0] += path[:, :1, :, 0].remainder(2) - path[:, :1, :, 0]  # starts within the period
    wrapped = torch.stack([path[..., 0].remainder(2), path[..., 1]], dim=-1)
    unwrap(wrapped, scene)
    torch.testing.assert_close(wrapped, path, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("shift", "coarse"), [(0.0, 0), (50.0, 0), (1e4, 1)])
def test_positions_that_float32_rounds_are_a_warning(make_dataset, shift, coarse):
    folder = make_dataset()
    recordings = recordings_of(folder)
    scene = recordings.reading.scene
    bounds, domain = (tuple((a + shift, b + shift) for a, b in box) for box in (scene.bounds, scene.domain))
    far = dataclasses.replace(scene, bounds=bounds, domain=domain)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        SplitRecordings(recordings.split, recordings.reader.metadata, Reading(far))
    assert [str(each.message).startswith(f"{folder}: coordinates are so far") for each in caught] == [True] * coarse
