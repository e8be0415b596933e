import subprocess
import sys
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nmpm.data.loading.background import AbandonedError, map_in_threads, raise_if_abandoned, run_in_thread


def test_runs_in_another_thread():
    assert run_in_thread(threading.get_ident).result() != threading.get_ident()


def test_result_raises_the_function_error():
    with pytest.raises(ZeroDivisionError):
        run_in_thread(lambda: 1 // 0).result()


def test_cancelling_stops_the_work_and_its_own_threads():
    begun, ended, before = threading.Event(), [], set(threading.enumerate())

    def work(item: int) -> None:
        begun.set()
        try:
            while True:
                raise_if_abandoned()
        except AbandonedError:
            ended.append(item)
            raise

    task = run_in_thread(map_in_threads, work, range(2), 2)
    assert begun.wait(60)
    task.cancel()
    assert set(threading.enumerate()) <= before
    with pytest.raises(AbandonedError):
        task.result()
    assert ended
    assert task.failed


def test_a_cancelled_task_stops_waiting_for_another():
    release = threading.Event()
    slow = run_in_thread(release.wait, 60)
    waiting = run_in_thread(slow.result)
    waiting.cancel()
    with pytest.raises(AbandonedError):
        waiting.result()
    assert not slow.failed
    release.set()
    assert slow.result() is True


@given(items=st.lists(st.integers(), max_size=20), workers=st.integers(1, 5))
def test_map_in_threads_keeps_the_order(items, workers):
    assert map_in_threads(lambda item: 2 * item, items, workers) == [2 * item for item in items]


def test_map_in_threads_stops_at_an_error():
    begun = []

    def work(item):
        begun.append(item)
        if item == 2:
            raise ValueError("two")

    with pytest.raises(ValueError, match="two"):
        map_in_threads(work, range(100), workers=1)
    assert begun == [0, 1, 2]


def test_the_program_exits_while_a_task_runs():
    script = """
from nmpm.data.loading.background import AbandonedError, raise_if_abandoned, raise_if_abandoned, run_in_thread

def work():
    while True:
        raise_if_abandoned()

run_in_thread(work)
"""
    assert subprocess.run([sys.executable, "-c", script], timeout=60, check=False).returncode == 0


def test_the_program_exits_while_trajectories_are_read(make_dataset):
    script = f"""
from nmpm.data.datamodule import TrajectoryDataModule
data = TrajectoryDataModule(path={str(make_dataset(train=((12, 5),) * 60))!r}, horizon=4, buffer_size=2, passes=0.01)
for _, window in zip(range(20), data.train_dataloader()):
    pass
"""
    assert subprocess.run([sys.executable, "-c", script], timeout=60, check=False).returncode == 0
