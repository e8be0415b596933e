"""Fields in datasets: what is declared, what it makes of the scene, and how it reaches the windows."""

import h5py
import numpy as np
import pytest
import torch

from nmpm.data.convert import Options
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.dataset import write_trajectories
from nmpm.data.format import Trajectory, read_metadata, write_metadata, write_split
from nmpm.data.inspection import inspect
from nmpm.data.scene_inference import infer_scene
from nmpm.data.sources import FolderSource
from nmpm.data.windows import collate
from nmpm.errors import ConfigError, DataError
from tests.made_up import made_up_metadata, made_up_trajectory

COUNTS = (5, 8, 6)


@pytest.fixture
def folder(tmp_path):
    """Three trajectories of different size, with a field of each kind, and boundary particles without values."""
    runs = []
    for index, count in enumerate(COUNTS):
        run = made_up_trajectory(12, count, seed=index, statics=2, fields=("temperature",))
        rng = np.random.default_rng(index)
        values = {
            "stiffness": rng.uniform(size=count + 2),
            "still": np.broadcast_to(rng.uniform(size=count + 2), (12, count + 2)),
            "pressure": np.full((12, count + 2), 3.0),
            "force": np.float32(index),
            "wind": rng.uniform(size=(12, 2)),
        }
        runs.append(Trajectory(run.position, run.particle_type, {"friction": 0.1 * index}, run.fields | values))
    for name in ("train", "valid", "test"):
        write_split(tmp_path / f"{name}.h5", runs)
    write_metadata(tmp_path, made_up_metadata(fields=("temperature", "force", "stiffness", "pressure", "friction")))
    return tmp_path


def data_of(folder, **options):
    return TrajectoryDataModule(path=str(folder), horizon=4, batch_size=4, buffer_size=3, passes=1.0, **options)


def test_the_kinds_follow_from_the_data_and_a_configuration_declares_others(folder):
    scene = infer_scene(folder)
    assert (scene.evolving, scene.properties) == (("temperature",), ("stiffness",))
    assert scene.parameters == ("force", "friction")  # in the order of the metadata
    assert "pressure" not in scene.fields
    assert data_of(folder, fields=["still"]).scene.properties == ("still",)
    assert data_of(folder, fields=[]).scene.fields == ()
    source = FolderSource(folder, Options(fields=["force"]))
    assert source.metadata.fields == ("force",)
    assert source.recordings("test")[0].fields.keys() == {"force"}


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("temprature", DataError, r"trajectory 00000: it has no field temprature.*it has: force, friction"),
        ("wind", DataError, r"wind is float64 of shape \(12, 2\); a field is \(T, N\)"),
        ("gravity", ConfigError, "cannot be called 'gravity'"),
    ],
)
def test_a_declared_field_that_is_missing_or_no_field_is_named(folder, name, error, message):
    with pytest.raises(error, match=message):
        infer_scene(folder, Options(fields=[name]))


def test_fields_that_do_not_fit_are_named(folder):
    with pytest.raises(ConfigError, match="fields cannot be combined with the simulated dataset goop"):
        TrajectoryDataModule(name="goop", fields=["temperature"])
    with h5py.File(folder / "test.h5", "r+") as file:
        file["00001/temperature"][3, 2] = np.inf
    with pytest.raises(DataError, match="temperature of particle 2 in frame 3 is inf"):
        data_of(folder).data_source.recordings("test")[1]
    with h5py.File(folder / "train.h5", "r+") as file:
        del file["00002/stiffness"]
        file["00002/stiffness"] = 1.0
    data = data_of(folder)
    with pytest.raises(DataError, match="stiffness has another shape in some trajectories"):
        collate(list(data.data_source.recordings("train")), data.reading)


def test_a_batch_pads_fields_without_touching_them(folder):
    data = data_of(folder)
    recordings = data.data_source.recordings("test")
    window = collate(list(recordings), data.reading)
    assert {name: tuple(values.shape) for name, values in window.fields.items()} == {
        "temperature": (3, 12, 8), "friction": (3, 1, 1), "stiffness": (3, 1, 8), "pressure": (3, 12, 8),
        "force": (3, 1, 1),
    }  # fmt: skip
    assert window.fields["force"].flatten().tolist() == [0, 1, 2]
    for row, (recording, count) in enumerate(zip(recordings, COUNTS, strict=True)):
        with h5py.File(folder / "test.h5") as file:
            temperature = torch.from_numpy(file[f"0000{row}/temperature"][:, :count]).float()
        assert torch.equal(recording.fields["temperature"], temperature)
        assert torch.equal(window.fields["temperature"][row, :, :count], temperature)
        assert (window.fields["temperature"][row, :, count:] == 0).all()
        assert torch.equal(window.initial.fields["temperature"][row, :count], temperature[1])
        assert torch.equal(window.field_target("temperature")[row, :, :count], temperature[2:])
    assert window.field_target("stiffness").shape == (3, 10, 8)


def test_training_windows_hold_the_frames_of_their_positions(folder):
    data = data_of(folder)
    data.setup("fit")
    window = next(iter(data.train_dataloader()))
    recordings = {recording.frames.shape[1]: recording for recording in data.data_source.recordings("train")}
    for row in range(4):
        count = int(window.mask[row].sum())
        recording, frames = recordings[count], window.frames[row, :, :count]
        start = next(first for first in range(7) if torch.equal(recording.frames[first : first + 6], frames))
        expected = recording.fields["temperature"][start : start + 6]
        assert torch.equal(window.fields["temperature"][row, :, :count], expected)
        assert torch.equal(window.fields["stiffness"][row, :, :count], recording.fields["stiffness"])


def test_an_inspection_says_what_varies_and_which_channels_that_makes(folder):
    found = inspect(FolderSource(folder))
    assert found.channels["temperature"].startswith("evolves, 0.9")
    assert found.channels["temperature"].endswith(": goop.temperature, predicted")
    assert found.channels["friction"] == "differs between trajectories, 0…0.2: friction"
    assert found.channels["pressure"] == "is the same everywhere, 3: no channel"
    assert found.channels["still"].endswith("not declared: no channel (--data.fields)")
    assert {"temperature", "friction", "stiffness", "force", "still"} <= set(found.varies)
    assert "wind" not in found.channels


def test_arrays_are_written_with_the_fields_of_their_scene(folder, tmp_path):
    scene = infer_scene(folder, Options(fields=["temperature"]))
    run, types = made_up_trajectory(12, 4, fields=("temperature",)), np.zeros(4, dtype=int)
    path = tmp_path / "new" / "train.h5"
    with pytest.raises(DataError, match="trajectory 0 has no field temperature, which the scene has"):
        write_trajectories(path, [Trajectory(run.position, types)], scene)
    write_trajectories(path, [Trajectory(run.position, types, fields=run.fields)], scene)
    assert read_metadata(path.parent).fields == ("temperature",)
    assert infer_scene(path.parent).evolving == ("temperature",)
