"""Processes that simulate give what threads give, report what goes wrong, and end with whoever started them."""

import dataclasses
import hashlib
import json
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nmpm.data import simulation_workers
from nmpm.data.generate import generate
from nmpm.data.parts import part_path, request_path
from nmpm.data.simulation_request import SimulationRequest
from nmpm.data.simulation_workers import ProcessWorker, ThreadWorker, start_workers
from nmpm.errors import DataError, UnstableError
from nmpm.sim import MpmPreset, load_preset

GOOP = load_preset("goop")
TINY = dataclasses.replace(GOOP, frames=30, blocks=dataclasses.replace(GOOP.blocks, particles=(150, 200)))
COUNTS = {"train": 4, "valid": 1, "test": 2}

SCRIPT = """
import json, sys
from pathlib import Path
from nmpm.data import simulation_workers
from nmpm.data.generate import generate
from nmpm.sim import preset_from_dict
simulation_workers.PER_PROCESS = 1
print("once", flush=True)
generate(preset_from_dict(json.loads(sys.argv[1])), Path(sys.argv[2]), json.loads(sys.argv[3]), seed=5, workers=2)
"""


@pytest.fixture
def in_processes(monkeypatch) -> None:
    """However few trajectories there are, processes simulate them."""
    monkeypatch.setattr(simulation_workers, "PER_PROCESS", 1)


@pytest.fixture
def prepared(tmp_path) -> Path:
    """A folder with the request of a dataset and no parts."""
    request_path(tmp_path).parent.mkdir()
    request_path(tmp_path).write_text(json.dumps(SimulationRequest(TINY, COUNTS, 5).to_dict()))
    return tmp_path


@pytest.fixture
def worker(prepared):
    started = ProcessWorker(prepared)
    yield started
    started.stop()


def script(folder: Path, preset: MpmPreset = TINY) -> subprocess.Popen[str]:
    words = [json.dumps(preset.to_dict()), str(folder), json.dumps(COUNTS)]
    return subprocess.Popen([sys.executable, "-c", SCRIPT, *words], stdout=subprocess.PIPE, text=True)


def fingerprints(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir() if path.is_file()}


@pytest.mark.usefixtures("in_processes")
def test_processes_give_the_bytes_of_threads_and_end(tmp_path, monkeypatch):
    started: list[ProcessWorker] = []
    make = ProcessWorker.__init__
    monkeypatch.setattr(
        ProcessWorker, "__init__", lambda worker, folder: started.append(worker) or make(worker, folder)
    )
    generate(TINY, tmp_path / "processes", COUNTS, seed=5, workers=2)
    assert len(started) == 2
    assert all(worker._process.poll() is not None for worker in started)
    generate(TINY, tmp_path / "thread", COUNTS, seed=5, workers=1)
    assert len(started) == 2
    assert fingerprints(tmp_path / "processes") == fingerprints(tmp_path / "thread")


def test_few_trajectories_are_not_worth_processes(prepared):
    request = SimulationRequest(TINY, COUNTS, 5)
    many = 2 * simulation_workers.PER_PROCESS
    assert all(isinstance(worker, ThreadWorker) for worker in start_workers(request, prepared, 2, many - 1))
    assert isinstance(start_workers(request, prepared, 1, 1000)[0], ThreadWorker)
    processes = start_workers(request, prepared, 2, many)
    assert [type(worker) for worker in processes] == [ProcessWorker] * 2
    for worker in processes:
        worker.stop()


@pytest.mark.usefixtures("in_processes")
def test_presets_of_a_users_class_stay_in_this_process(prepared):
    class Own(MpmPreset):
        """A user's."""

    own = Own(**{field.name: getattr(TINY, field.name) for field in dataclasses.fields(TINY)})
    workers = start_workers(SimulationRequest(own, COUNTS, 5), prepared, 2, 7)
    assert [type(worker) for worker in workers] == [ThreadWorker] * 2


def test_a_script_without_a_main_guard_simulates_in_processes(tmp_path):
    process = script(tmp_path / "made")
    assert process.communicate(timeout=120)[0] == "once\n"
    assert process.returncode == 0
    assert (tmp_path / "made" / "metadata.json").is_file()


@pytest.mark.usefixtures("in_processes")
def test_errors_and_warnings_of_a_process_are_those_of_a_thread(tmp_path, caplog):
    torn = dataclasses.replace(TINY, gravity=(0.0, -1e30))
    with caplog.at_level(logging.WARNING), pytest.raises(UnstableError, match="5 seeds in a row are unstable"):
        generate(torn, tmp_path, COUNTS, seed=5, workers=2)
    assert "Another seed takes the place of" in caplog.text


def test_a_part_that_cannot_be_written_is_an_error_of_the_system(worker, prepared):
    part_path(prepared, "train", 0).mkdir()
    with pytest.raises(OSError, match="train-00000"):
        worker.simulate("train", 0)
    worker.simulate("train", 1)
    assert part_path(prepared, "train", 1).is_file()


def test_other_failures_show_their_traceback(worker):
    with pytest.raises(RuntimeError, match=r"(?s)The simulation of nowhere 0 failed:.*Traceback.*ValueError"):
        worker.simulate("nowhere", 0)


def test_a_killed_process_is_named_with_what_it_simulated(worker):
    worker._process.kill()
    with pytest.raises(DataError, match=r"A process that simulated train 0 ended with status -9.*Repeat the call"):
        worker.simulate("train", 0)


@pytest.mark.skipif(os.name != "posix", reason="kill -9")
def test_processes_end_with_a_killed_parent(tmp_path):
    long, folder = dataclasses.replace(TINY, frames=3000), tmp_path / "made"
    process = script(folder, long)
    assert process.stdout.readline() == "once\n"
    children = wait_for(lambda: running_for(folder), count=2)
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_for(lambda: running_for(folder), count=0)
    assert children
    assert not (folder / "metadata.json").exists()


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
