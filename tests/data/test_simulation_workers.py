"""Processes that simulate give what threads give, report what goes wrong, and end with whoever started them."""

import dataclasses
import gc
import json
import logging
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from nmpm.data import simulation_workers
from nmpm.data.generate import generate
from nmpm.data.parts import part_path, request_path
from nmpm.data.simulation_request import SimulationRequest
from nmpm.data.simulation_workers import ProcessWorker, ThreadWorker, started_workers
from nmpm.errors import DataError, UnstableError
from nmpm.sim import MpmPreset
from tests.data.tiny_goop import COUNTS, TINY, fingerprints

ENDLESS = dataclasses.replace(TINY, frames=500_000)
"""A trajectory of it takes minutes."""
REQUEST = SimulationRequest(TINY, COUNTS, 5)

SCRIPT = """
import json, signal, sys
from pathlib import Path
from nmpm.data import simulation_workers
from nmpm.data.generate import generate
from nmpm.sim import preset_from_dict
signal.signal(signal.SIGINT, signal.default_int_handler)  # where tests run in the background it is ignored
simulation_workers.FRAMES_PER_PROCESS = 1
print("once", flush=True)
generate(preset_from_dict(json.loads(sys.argv[1])), Path(sys.argv[2]), json.loads(sys.argv[3]), seed=5, workers=2)
"""


@pytest.fixture
def in_processes(monkeypatch) -> None:
    """However little there is to do, processes simulate it."""
    monkeypatch.setattr(simulation_workers, "FRAMES_PER_PROCESS", 1)


@pytest.fixture
def prepared(tmp_path) -> Path:
    """A folder with the request of a dataset and no parts."""
    request_path(tmp_path).parent.mkdir()
    request_path(tmp_path).write_text(json.dumps(REQUEST.to_dict()))
    return tmp_path


@pytest.fixture
def worker(prepared):
    started = ProcessWorker(prepared)
    yield started
    started.close()


@pytest.fixture
def script():
    """Starts a script that simulates into a folder; kills it at the end of the test, however that ends."""
    started: list[subprocess.Popen[str]] = []

    def start(folder: Path, preset: MpmPreset, **options) -> subprocess.Popen[str]:
        words = [json.dumps(preset.to_dict()), str(folder), json.dumps(COUNTS)]
        pipes = {"stdout": subprocess.PIPE, "text": True} | options
        started.append(subprocess.Popen([sys.executable, "-c", SCRIPT, *words], **pipes))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def running_for(folder: Path) -> list[int]:
    """Processes that simulate for a folder."""
    listed = subprocess.run(["ps", "-eww", "-o", "pid,args"], capture_output=True, text=True, check=True).stdout
    return [int(line.split()[0]) for line in listed.splitlines() if "serve()" in line and str(folder) in line]


def wait_for(find, count: int, seconds: float = 60):
    end = time.monotonic() + seconds
    while len(found := find()) != count:
        assert time.monotonic() < end, f"{found} after {seconds} s"
        time.sleep(0.05)
    return found


@pytest.mark.usefixtures("in_processes")
def test_processes_give_the_bytes_of_threads_and_leave_nothing_open(tmp_path, monkeypatch):
    started: list[ProcessWorker] = []

    def start(folder):
        started.append(ProcessWorker(folder))
        return started[-1]

    monkeypatch.setattr(simulation_workers, "ProcessWorker", start)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        generate(TINY, tmp_path / "processes", COUNTS, seed=5, workers=2)
        assert len(started) == 2
        assert all(worker._process.poll() is not None for worker in started)
        started.clear()
        gc.collect()
    assert not [warning for warning in caught if warning.category is ResourceWarning]
    generate(TINY, tmp_path / "thread", COUNTS, seed=5, workers=1)
    assert not started
    assert fingerprints(tmp_path / "processes") == fingerprints(tmp_path / "thread")


def kinds(request: SimulationRequest, folder: Path, count: int, trajectories: int) -> list[type]:
    with started_workers(request, folder, count, trajectories) as workers:
        return [type(worker) for worker in workers]


def test_few_frames_are_not_worth_processes(prepared):
    many = 2 * simulation_workers.FRAMES_PER_PROCESS // TINY.frames
    assert kinds(REQUEST, prepared, 2, many - 1) == [ThreadWorker] * 2
    assert kinds(REQUEST, prepared, 1, 1000) == [ThreadWorker]
    assert kinds(REQUEST, prepared, 2, many) == [ProcessWorker] * 2


@pytest.mark.usefixtures("in_processes")
def test_presets_of_a_users_class_and_programs_that_are_no_python_stay_in_this_process(prepared, monkeypatch):
    class Own(MpmPreset):
        """A user's."""

    own = Own(**{field.name: getattr(TINY, field.name) for field in dataclasses.fields(TINY)})
    assert kinds(SimulationRequest(own, COUNTS, 5), prepared, 2, 7) == [ThreadWorker] * 2
    monkeypatch.setattr(sys, "executable", "")
    assert kinds(REQUEST, prepared, 2, 7) == [ThreadWorker] * 2


def test_a_script_without_a_main_guard_simulates_in_processes_wherever_it_runs(tmp_path):
    work = tmp_path / "a folder"
    work.mkdir()
    (work / "random.py").write_text("raise RuntimeError('imported from the working directory')")
    (tmp_path / "script.py").write_text(SCRIPT)
    words = [json.dumps(TINY.to_dict()), str(tmp_path / "made here"), json.dumps(COUNTS)]
    done = subprocess.run(
        [sys.executable, str(tmp_path / "script.py"), *words], cwd=work, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "once\n"), done.stderr
    assert (tmp_path / "made here" / "metadata.json").is_file()


@pytest.mark.usefixtures("in_processes")
def test_errors_and_warnings_of_a_process_are_those_of_a_thread(tmp_path, caplog):
    torn = dataclasses.replace(TINY, gravity=(0.0, -1e30))
    with caplog.at_level(logging.WARNING), pytest.raises(UnstableError, match="5 seeds in a row are unstable"):
        generate(torn, tmp_path, COUNTS, seed=5, workers=2)
    assert "Another seed takes the place of" in caplog.text
    assert not running_for(tmp_path)


def test_a_part_that_cannot_be_written_is_an_error_of_the_system(worker, prepared):
    part_path(prepared, "train", 0).mkdir()
    with pytest.raises(OSError, match="train-00000"):
        worker.simulate("train", 0)
    worker.simulate("train", 1)
    assert part_path(prepared, "train", 1).is_file()


def test_other_failures_show_their_traceback(worker):
    with pytest.raises(RuntimeError, match=r"(?s)The simulation of nowhere 0 failed:.*Traceback.*ValueError"):
        worker.simulate("nowhere", 0)


def test_what_a_process_prints_is_no_answer(worker, prepared, tmp_path_factory, monkeypatch):
    place = tmp_path_factory.mktemp("site")
    (place / "sitecustomize.py").write_bytes(b"import os\nos.write(1, b'printed at the start, \\xff\\n')\n")
    monkeypatch.setattr(sys, "path", [str(place), *sys.path])
    talkative = ProcessWorker(prepared)
    try:
        talkative.simulate("train", 0)
    finally:
        talkative.close()
    assert part_path(prepared, "train", 0).is_file()


def test_a_process_that_ends_is_named_with_what_it_simulated(worker, prepared, monkeypatch):
    worker._process.kill()
    with pytest.raises(DataError, match=r"A process that simulated train 0 ended with status -9: was it killed"):
        worker.simulate("train", 0)
    request_path(prepared).write_text("{}")
    broken = ProcessWorker(prepared)
    with pytest.raises(DataError, match=r"ended with status 1: see its traceback above\. Repeat the call"):
        broken.simulate("train", 0)
    broken.close()
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(DataError, match=r"cannot be started .*ask for fewer workers"):
        ProcessWorker(prepared)


def test_a_stopped_process_leaves_no_half_written_part(worker, prepared):
    left = part_path(prepared, "train", 0).with_name(f".train-00000.{worker._process.pid}.0123abcd.part.npz")
    left.write_bytes(b"half")
    worker.stop()
    assert not left.exists()


@pytest.mark.parametrize("seconds", [0.0, 3.0], ids=["at the start", "while they simulate"])
def test_processes_end_with_a_killed_parent_and_write_nothing_more(tmp_path, script, seconds):
    folder = tmp_path / "made"
    process = script(folder, ENDLESS)
    wait_for(lambda: running_for(folder), count=2)
    time.sleep(seconds)
    process.kill()
    process.wait()
    wait_for(lambda: running_for(folder), count=0, seconds=30)
    assert not list(folder.glob(".parts/*.npz"))


@pytest.mark.skipif(os.name != "posix", reason="signals of a group of processes")
def test_ctrl_c_ends_all_processes_at_once(tmp_path, script):
    folder = tmp_path / "made"
    process = script(folder, ENDLESS, stderr=subprocess.PIPE, process_group=0)
    wait_for(lambda: running_for(folder), count=2)
    time.sleep(2)
    os.killpg(process.pid, signal.SIGINT)
    _, text = process.communicate(timeout=30)
    assert process.returncode != 0
    assert text.count("Traceback (most recent call last)") == 1  # the script's own
    assert not running_for(folder)
