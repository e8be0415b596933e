import dataclasses
import threading
from itertools import islice

import pytest
import torch

from nmpm._support.threads import AbandonedError, Task
from nmpm.data.batches import EndlessWindowPlan, TrajectoryBuffer
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.simulated_sources import SimulatedRecordings
from nmpm.data.windows import collate
from nmpm.errors import ConfigError
from nmpm.scene import Reading
from nmpm.sim import MpmPreset, load_preset

GOOP = load_preset("goop")
TINY = dataclasses.replace(GOOP, frames=8, blocks=dataclasses.replace(GOOP.blocks, particles=(40, 60)))
PLAN = EndlessWindowPlan(frames=(9, 9), length=5, batch_size=3, buffer_size=2, passes=1, seed=0)


def live(**changes) -> SimulatedRecordings:
    return SimulatedRecordings(TINY, **({"workers": 2} | changes))


def test_an_index_is_always_the_same_trajectory_and_simulated_once(simulated_seeds):
    recordings = live()
    (three, four), (_, again), (other,) = recordings.load([3, 4]), live().load([5, 3]), live(seed=1).load([3])
    assert torch.equal(three.frames, again.frames)
    for differing in (four, other):
        assert three.frames.shape != differing.frames.shape or not torch.equal(three.frames, differing.frames)
    simulated_seeds.clear()
    for indices in ([0, 1], [3, 4], [0, 1], [3, 4]):
        recordings.load(indices)
    assert len(simulated_seeds) == 2


def test_resumes_at_any_batch():
    straight = list(islice(TrajectoryBuffer(live(), PLAN).batches(), 12))
    resumed = list(islice(TrajectoryBuffer(live(), PLAN).batches(start=5), 7))
    for expected, window in zip(straight[5:], resumed, strict=True):
        assert torch.equal(window.frames, expected.frames)


@pytest.mark.parametrize(("earlier", "world"), [(1, 2), (3, 2)])
def test_no_trajectory_is_seen_again_by_another_number_of_ranks(earlier, world):
    seen = {index for rank in range(earlier) for batch in range(7) for index, _ in PLAN.batch(batch, rank, earlier)}
    after = PLAN.resume_after(7, PLAN.batch_size, earlier, world)
    more = {index for rank in range(world) for batch in range(7, 14) for index, _ in after.batch(batch, rank, world)}
    assert max(seen) < min(more) <= max(seen) + 2 * world


def test_closing_stops_simulations_and_a_later_request_starts_anew(monkeypatch):
    simulate, begun, endless = MpmPreset.simulate, threading.Event(), [True]

    def waits(preset, seed, progress):
        begun.set()
        while endless:
            progress(0)
        return simulate(preset, seed, progress=progress)

    monkeypatch.setattr(MpmPreset, "simulate", waits)
    recordings = live()
    waiting = Task(lambda: recordings.load([0, 1]))
    assert begun.wait(60)
    recordings.close()
    with pytest.raises(AbandonedError):
        waiting.result()
    endless.clear()
    assert len(recordings.load([0, 1])) == 2


def test_a_horizon_longer_than_the_trajectories_is_refused():
    with pytest.raises(ConfigError, match=r"goop: its trajectories have 9 frames, .* needs 10"):
        TrajectoryDataModule(name="goop", source="simulate", horizon=8, generate={"frames": 8}).train_dataloader()


@pytest.mark.usefixtures("home")
def test_calibration_and_training_share_their_trajectories_which_are_not_written(simulated_seeds):
    options = {"counts": {"train": 5, "valid": 1, "test": 1}, "frames": 6}
    module = TrajectoryDataModule(
        name="goop", source="simulate", horizon=3, batch_size=2, buffer_size=2, generate=options
    )
    others = threading.enumerate()  # such as that of other tests' progress
    calibration, training = (list(islice(module.train_dataloader(), 2)) for _ in range(2))
    module.teardown("fit")
    assert all(torch.equal(one.frames, other.frames) for one, other in zip(calibration, training, strict=True))
    assert training[0].frames.shape[:2] == (2, 5)
    assert len(simulated_seeds) == len(set(simulated_seeds))
    assert not [thread for thread in threading.enumerate() if thread not in others]
    assert len(next(iter(module.val_dataloader())).frames) == 1
    assert sorted(path.name for path in module.data_source.folder.glob("*.h5")) == ["test.h5", "valid.h5"]
    assert "simulated by nmpm while training" in module.description


def test_a_reading_renames_materials_and_skips_frames():
    scene = dataclasses.replace(TINY.scene, materials=("clay",), dt=2 * TINY.scene.dt)
    recordings, (plain,) = live(), live().load([3])
    recordings.reading = Reading(scene, {"goop": "clay"}, every=2)
    (read,) = recordings.load([3])
    assert torch.equal(read.frames, plain.frames)
    torch.testing.assert_close(read.gravity, 4 * plain.gravity)
    window = collate([read], recordings.reading)
    assert torch.equal(window.frames[0], plain.frames[::2])
    recordings.reading = Reading(TINY.scene)
    assert torch.equal(recordings.load([3])[0].gravity, plain.gravity)
