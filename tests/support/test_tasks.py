import subprocess
import sys
import threading

import pytest

from nmpm._support.threads import AbandonedError, Task, raise_if_abandoned


def test_a_task_gives_the_value_or_the_error_of_its_function():
    assert Task(threading.get_ident).result() != threading.get_ident()
    with pytest.raises(ZeroDivisionError):
        Task(lambda: 1 // 0).result()


def test_cancelling_stops_the_work():
    begun, before = threading.Event(), set(threading.enumerate())

    def work() -> None:
        begun.set()
        while True:
            raise_if_abandoned()

    task = Task(work)
    assert begun.wait(60)
    task.cancel()
    assert set(threading.enumerate()) <= before
    with pytest.raises(AbandonedError):
        task.result()
    assert task.failed


READS = """
from nmpm.data.datamodule import TrajectoryDataModule
data = TrajectoryDataModule(path={path!r}, horizon=4, buffer_size=2, passes=0.01)
for _, window in zip(range(20), data.train_dataloader()):
    pass
"""
SIMULATES = """
import dataclasses, time
from nmpm.data import simulation
from nmpm._support.threads import Task
from nmpm.data.simulated_sources import SimulatedRecordings
from nmpm.sim import load_preset
simulation.FRAMES_PER_PROCESS = 1
recordings = SimulatedRecordings(dataclasses.replace(load_preset("goop"), frames=500_000), workers=2)
task = Task(lambda: recordings.load([0, 1, 2]))
time.sleep(3)
"""


@pytest.mark.parametrize(
    "script", [pytest.param(READS, marks=pytest.mark.slow, id="read"), pytest.param(SIMULATES, id="simulated")]
)
def test_the_program_exits_while_trajectories_are_made(make_dataset, script):
    script = script.format(path=str(make_dataset(train=((12, 5),) * 60)))
    done = subprocess.run([sys.executable, "-c", script], timeout=60, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
