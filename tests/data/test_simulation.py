"""Processes that simulate give what this one gives, report what goes wrong, and end with whoever started them."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from nmpm.data import simulation
from nmpm.data.generate import generate
from nmpm.data.simulation import simulate_all
from nmpm.errors import DataError, UnstableError
from nmpm.sim import MpmPreset
from tests.data.tiny_goop import COUNTS, TINY, fingerprints

ENDLESS = dataclasses.replace(TINY, frames=500_000)
"""A trajectory of it takes minutes."""

SCRIPT = """
import json, signal, sys
from pathlib import Path
from nmpm.data import simulation
from nmpm.data.generate import generate
from nmpm.sim import MpmPreset
class Own(MpmPreset):
    pass
signal.signal(signal.SIGINT, signal.default_int_handler)  # where tests run in the background it is ignored
simulation.FRAMES_PER_PROCESS = 1
print("once", flush=True)
plain = {key: value for key, value in json.loads(sys.argv[1]).items() if key != "solver"}
generate(Own.from_dict(plain), Path(sys.argv[2]), json.loads(sys.argv[3]), seed=5, workers=2)
"""


@pytest.fixture
def in_processes(monkeypatch) -> None:
    """However little there is to do, processes simulate it."""
    monkeypatch.setattr(simulation, "FRAMES_PER_PROCESS", 1)


@pytest.fixture
def endless(tmp_path):
    """A script whose two processes simulate for minutes; it is killed at the end of the test."""
    words = [sys.executable, "-c", SCRIPT, json.dumps(ENDLESS.to_dict()), str(tmp_path / "made"), json.dumps(COUNTS)]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, process_group=0)
    yield process
    process.kill()
    process.communicate()


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    words = ["ps", "-eww", "-o", "pid,ppid,args"]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    return [int(line.split()[0]) for line in lines if line.split()[1] == str(process.pid) and "popen_loky" in line]


def wait_until(holds, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.05)


def running(pids: list[int]) -> list[int]:
    """Processes that are neither gone nor zombies."""
    listed = subprocess.run(["ps", "-o", "pid=,stat=", "-p", ",".join(map(str, pids))], capture_output=True, text=True)
    return [line for line in listed.stdout.splitlines() if "Z" not in line]


@pytest.mark.usefixtures("in_processes")
def test_processes_give_the_same_bytes(tmp_path):
    generate(TINY, tmp_path / "processes", COUNTS, seed=5, workers=2)
    generate(TINY, tmp_path / "here", COUNTS, seed=5, workers=1)
    assert fingerprints(tmp_path / "processes") == fingerprints(tmp_path / "here")


def test_a_script_without_a_main_guard_simulates_a_preset_of_its_own_wherever_it_runs(tmp_path):
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
def test_errors_of_a_process_are_raised(tmp_path):
    torn = dataclasses.replace(TINY, gravity=(0.0, -1e30))
    with pytest.raises(UnstableError, match="5 seeds in a row are unstable"):
        generate(torn, tmp_path, COUNTS, seed=5, workers=2)


@pytest.mark.usefixtures("in_processes")
def test_warnings_of_processes_are_logged_and_their_end_is_explained_at_once(monkeypatch, caplog):
    unstable, killed, endless = (simulation.seed_of_draw((number,), 0) for number in (7, 8, 9))

    class Odd(MpmPreset):
        def simulate(self, seed, progress=None):
            if seed == unstable:
                raise UnstableError("blown up")
            if seed == killed:
                os.kill(os.getpid(), signal.SIGKILL)
            if seed == endless:
                time.sleep(600)
            return super().simulate(seed, progress)

    odd = Odd(**{field.name: getattr(TINY, field.name) for field in dataclasses.fields(TINY)})
    runs = dict(simulate_all(odd, [(6,), (7,)], 2))
    assert [runs[index].attributes["seed"] for index in (0, 1)] == [
        simulation.seed_of_draw((6,), 0),
        simulation.seed_of_draw((7,), 1),
    ]
    assert "Another seed takes the place of" in caplog.text
    with pytest.raises(DataError, match="A process that simulates has ended: was it killed, or is memory short"):
        list(simulate_all(odd, [(9,), (8,)], 2))


def test_processes_end_with_a_killed_parent_and_write_nothing_more(tmp_path, endless):
    wait_until(lambda: len(workers_of(endless)) == 2)
    pids = workers_of(endless)
    time.sleep(2)
    endless.kill()
    endless.wait()
    wait_until(lambda: not running(pids), seconds=30)
    assert not list(tmp_path.glob("made/.parts/*.npz"))


def test_ctrl_c_ends_all_processes_at_once(endless):
    wait_until(lambda: len(workers_of(endless)) == 2)
    pids = workers_of(endless)
    time.sleep(2)
    os.killpg(endless.pid, signal.SIGINT)
    _, text = endless.communicate(timeout=30)
    assert endless.returncode != 0
    assert text.count("Traceback (most recent call last)") == 1, text  # the script's own
    assert not running(pids)
