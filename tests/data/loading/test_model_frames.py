"""Data that are read for a model: other names of materials, and other frames."""

import dataclasses
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.format import Split, Trajectory, write_metadata, write_split
from nmpm.data.recordings import SplitRecordings
from nmpm.data.sources import FolderSource
from nmpm.data.windows import collate, model_velocity
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.comparison import free_fall
from nmpm.particles import Window
from nmpm.scene import Reading, Scene
from tests.made_up import made_up_metadata, made_up_trajectory

GRAVITY, DT = -9.81, 0.0025
WITH_PADDLE = {"particle_types": {2: "paddle", 7: "goop"}, "static_types": frozenset(), "prescribed_types": {2}}


def fall(frames: int, every: int = 1, seed: int = 0) -> Trajectory:
    """Thrown particles in free fall, in every so-maniest of their frames; the field and gravity's are in seconds."""
    rng = np.random.default_rng(seed)
    start, speed = rng.uniform(0.4, 0.6, (1, 6, 2)), rng.normal(scale=1e-3, size=(1, 6, 2))
    n = np.arange(0, frames * every, every)[:, None, None]
    position = start + speed * n + np.array([0, GRAVITY * DT**2]) * n * (n + 1) / 2
    heat = np.broadcast_to(0.5 * n[..., 0], (frames, 6)).astype(np.float32)
    return Trajectory(position.astype(np.float32), np.full(6, 7), {"seed": seed}, {"heat": heat})


def written(folder: Path, runs: list[Trajectory], **changes) -> Path:
    for name in ("train", "valid", "test"):
        write_split(folder / f"{name}.h5", runs)
    write_metadata(folder, made_up_metadata(sequence_length=len(runs[0].position) - 1, **changes))
    return folder


def reading_of(folder: Path, **changes) -> Reading:
    """The reading with every k-th frame, or k frames between, and goop as the model's clay."""
    reading = Reading(FolderSource(folder).scene, {"goop": "clay"}, **changes)
    dt = reading.scene.dt * reading.every / reading.between
    return dataclasses.replace(reading, scene=dataclasses.replace(reading.scene, materials=("clay",), dt=dt))


def data_of(folder: Path, reading: Reading, **options) -> TrajectoryDataModule:
    data = TrajectoryDataModule(str(folder), **({"horizon": 8, "batch_size": 4, "buffer_size": 2} | options))
    data.reading = reading
    return data


def whole(folder: Path, reading: Reading) -> Window:
    return next(iter(data_of(folder, reading).test_dataloader()))


def free_path(scene: Scene, window: Window) -> torch.Tensor:
    return free_fall(scene, window.initial, window.target.shape[1])


def test_materials_get_the_models_names_and_others_are_refused(tmp_path):
    folder = written(tmp_path, [made_up_trajectory(9, 4)])
    reading = reading_of(folder)
    assert data_of(folder, reading).scene.materials == ("clay",)
    plain, read = whole(folder, Reading(FolderSource(folder).scene)), whole(folder, reading)
    assert all(torch.equal(value, vars(read)[name]) for name, value in vars(plain).items() if torch.is_tensor(value))
    assert read.observed is None
    wrong = dataclasses.replace(reading, materials={})
    with pytest.raises(DataError, match=r"the material 'goop' .* is not in the scene, which has clay"):
        whole(folder, wrong)


@pytest.mark.parametrize("every", [2, 3])
def test_free_fall_over_skipped_frames_is_exact(tmp_path, every):
    folder = written(tmp_path, [fall(20), fall(20, seed=1)])
    reading = reading_of(folder, every=every)
    window = whole(folder, reading)
    assert window.frames.shape[1] == reading.model_frames(20) == 1 + 19 // every
    torch.testing.assert_close(free_path(reading.scene, window), window.target, rtol=0, atol=1e-6)
    batches = islice(data_of(folder, reading, horizon=4).train_dataloader(), 20)
    starts = {tuple(frames[0, 0].tolist()) for batch in batches for frames in batch.frames}
    assert len(starts) == 2 * (20 - 5 * every)  # windows begin at any frame of the data


@pytest.mark.parametrize("between", [2, 3, 4])
def test_free_fall_with_frames_that_the_data_lack_is_exact(tmp_path, between):
    folder = written(tmp_path, [fall(9, between), fall(9, between, seed=1)], dt=DT * between, fields=("heat",))
    reading = reading_of(folder, between=between)
    window = whole(folder, reading)
    assert window.frames.shape[1] == reading.model_frames(9) == 2 + 7 * between
    assert window.observed.tolist() == [[(frame - 1) % between == 0 for frame in range(2 + 7 * between)]] * 2
    plain = whole(folder, None)
    assert torch.equal(window.frames[:, 1::between], plain.frames[:, 1:])
    torch.testing.assert_close(free_path(reading.scene, window), window.target, rtol=0, atol=1e-6)
    torch.testing.assert_close(window.fields["heat"].diff(dim=1), torch.full_like(window.frames[:, 1:, :, 0], 0.5))
    for batch in islice(data_of(folder, reading).train_dataloader(), 8):
        assert batch.frames.shape[1] >= 10
        torch.testing.assert_close(free_path(reading.scene, batch), batch.target, rtol=0, atol=1e-6)


def test_a_stride_at_reading_is_as_good_as_one_at_writing(tmp_path):
    runs = [made_up_trajectory(17, 5, seed, statics=2) for seed in range(2)]
    sparse = [Trajectory(run.position[::2], run.particle_type, run.attributes) for run in runs]
    (tmp_path / "all").mkdir(), (tmp_path / "half").mkdir()
    all_frames, half = written(tmp_path / "all", runs), written(tmp_path / "half", sparse, dt=2 * DT)
    one, other = whole(all_frames, reading_of(all_frames, every=2)), whole(half, reading_of(half))
    assert all(torch.equal(value, vars(other)[name]) for name, value in vars(one).items() if torch.is_tensor(value))


def test_particles_at_rest_are_not_thrown_and_collisions_not_extrapolated():
    gravity, velocity = torch.tensor([[0.0, -16.0]]), partial(model_velocity, ratio=1 / 4)
    unknown = torch.full((1, 2), torch.nan)
    rest, falling = torch.zeros(1, 2), torch.tensor([[0.0, -20.0]])
    assert torch.equal(velocity(rest, unknown, gravity), rest)
    assert torch.equal(velocity(rest, rest, gravity), rest)
    assert torch.equal(velocity(falling, unknown, gravity), velocity(falling, gravity, gravity))
    assert velocity(falling, gravity, gravity).tolist() == [[0.0, -5.0 - 1.5]]
    bounced = velocity(torch.tensor([[0.0, 80.0]]), torch.tensor([[0.0, 160.0]]), gravity)
    assert bounced.tolist() == [[0.0, 20.0 + 40 * 3 / 32]]  # half of the step in place of twice as much


@pytest.mark.parametrize("ratio", [3, 2, 1 / 2, 1 / 4])
def test_velocities_at_constant_acceleration_are_exact(ratio):
    def fallen(frame: float) -> torch.Tensor:
        return 3.0 * frame - frame * (frame + 1) / 2 * torch.tensor([[0.0, 1.0]], dtype=torch.float64)

    step, before = fallen(12) - fallen(0), fallen(0) - fallen(-12)
    estimate = model_velocity(step, step - before, torch.tensor([[0.0, -144.0]]), ratio)
    torch.testing.assert_close(estimate, fallen(12) - fallen(12 - 12 * ratio))


def test_obstacles_and_presence_lie_between_those_of_the_data(tmp_path):
    run = made_up_trajectory(8, 5)
    position, types = run.position.copy(), run.particle_type.copy()
    types[4] = 2
    position[:, 4] = np.array([0.3, 0.3]) + 0.04 * np.arange(8)[:, None]
    position[:3, 1] = position[5:, 0] = np.nan
    folder = written(tmp_path, [Trajectory(position, types)], **WITH_PADDLE)
    reading = reading_of(folder, between=4)
    window = whole(folder, reading)
    torch.testing.assert_close(window.obstacle_frames.diff(dim=1), torch.full((1, 25, 1, 2), 0.01))
    torch.testing.assert_close(window.initial.obstacle_velocity, torch.full((1, 1, 2), 0.01))
    assert torch.equal(window.obstacle, window.obstacle_frames[:, 1])
    there = window.present[0].T.tolist()
    assert there[0] == [frame <= 1 + 4 * 3 for frame in range(26)]
    assert there[1] == [frame >= 1 + 4 * 2 for frame in range(26)]
    skipped = whole(folder, reading_of(folder, every=3))
    assert skipped.present[0, :, :2].tolist() == [[True, False], [True, True], [False, True]]
    torch.testing.assert_close(skipped.obstacle_frames.diff(dim=1), torch.full((1, 2, 1, 2), 0.12))


def test_steps_across_a_period_are_counted_in_the_datas_frames(tmp_path):
    position = np.full((13, 2, 2), 0.5, dtype=np.float32)
    position[..., 0] = 0.1 + np.mod(0.3 * np.arange(13)[:, None], 0.8)
    position[:, 1, 1] = 0.6
    folder = written(tmp_path, [Trajectory(position, np.full(2, 7))], boundary=("periodic", "wall"), gravity=None)
    window = whole(folder, reading_of(folder, every=3))
    torch.testing.assert_close(window.frames[0, :, 0].diff(dim=0), torch.tensor([[0.9, 0.0]]).expand(4, 2))
    window = whole(folder, reading_of(folder, between=3))
    torch.testing.assert_close(window.frames[0, :, 0].diff(dim=0), torch.tensor([[0.1, 0.0]]).expand(34, 2))


def test_too_short_horizons_and_trajectories_are_refused(tmp_path):
    folder = written(tmp_path, [fall(9)])
    with pytest.raises(ConfigError, match="every 9th of the model's frames, none of the 8 that a training step"):
        data_of(folder, reading_of(folder, between=9)).train_dataloader()
    with pytest.raises(DataError, match="longest trajectory has 9 frames, a training window needs 19"):
        data_of(folder, reading_of(folder, every=2)).train_dataloader()
    with pytest.raises(DataError, match="longest trajectory has 9 frames, an evaluation needs 11"):
        data_of(folder, reading_of(folder, every=5)).test_dataloader()


def test_only_the_models_frames_are_needed(tmp_path):
    folder = written(tmp_path, [fall(9), fall(9, seed=1)])
    reading = reading_of(folder, between=4)
    recordings = SplitRecordings(Split(folder / "test.h5"), FolderSource(folder).metadata, reading)
    window = collate([recordings[0]], reading, 3)
    assert window.observed.tolist() == [[False, True, False, False, False, True]]
