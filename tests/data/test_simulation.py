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
from nmpm.data.simulation import DRAWS, generate, seed_of_draw, simulate_all
from nmpm.errors import DataError, UnstableError
from nmpm.sim import MpmPreset
from tests.data.tiny_goop import COUNTS, TINY, fingerprints

ENDLESS = dataclasses.replace(TINY, frames=500_000)
"""A trajectory of it takes minutes."""

SCRIPT = """
import json, signal, sys
from pathlib import Path
from nmpm.data import simulation
from nmpm.data.simulation import generate
from nmpm.sim import MpmPreset
class Own(MpmPreset):
    pass
signal.signal(signal.SIGINT, signal.default_int_handler)  # where tests run in the background it is ignored
simulation.FRAMES_PER_PROCESS = 1
print("once", flush=True)
plain = {key: value for key, value in json.loads(sys.argv[1]).items() if key != "solver"}
generate(Own.from_dict(plain), Path(sys.argv[2]), json.loads(sys.argv[3]), seed=5, workers=2)
"""


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    words = ["ps", "-eww", "-o", "pid,ppid,args"]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    return [int(line.split()[0]) for line in lines if line.split()[1] == str(process.pid) and "popen_loky" in line]


def wait_until(holds, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.05)


def running(pids: list[int]) -> list[str]:
    """Processes that are neither gone nor zombies."""
    listed = subprocess.run(["ps", "-o", "pid=,stat=", "-p", ",".join(map(str, pids))], capture_output=True, text=True)
    return [line for line in listed.stdout.splitlines() if "Z" not in line]


def test_a_script_without_a_main_guard_gives_the_same_bytes_of_its_own_preset_wherever_it_runs(tmp_path):
    work = tmp_path / "a folder"
    work.mkdir()
    (work / "random.py").write_text("raise RuntimeError('imported from the working directory')")
    (tmp_path / "script.py").write_text(SCRIPT)
    words = [sys.executable, str(tmp_path / "script.py"), json.dumps(TINY.to_dict()), str(tmp_path / "made there")]
    done = subprocess.run([*words, json.dumps(COUNTS)], cwd=work, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "once\n"), done.stderr
    generate(TINY, tmp_path / "here", COUNTS, seed=5, workers=1)
    assert fingerprints(tmp_path / "made there") == fingerprints(tmp_path / "here")


def test_warnings_and_errors_of_processes_are_raised_here_and_their_end_is_explained_at_once(monkeypatch, caplog):
    monkeypatch.setattr(simulation, "FRAMES_PER_PROCESS", 1)
    unstable = [seed_of_draw((7,), 0), *(seed_of_draw((5,), draw) for draw in range(DRAWS))]
    killed, endless = (seed_of_draw((number,), 0) for number in (8, 9))

    class Odd(MpmPreset):
        def simulate(self, seed, progress=None):
            if seed in unstable:
                raise UnstableError("blown up")
            if seed == killed:
                os.kill(os.getpid(), signal.SIGKILL)
            if seed == endless:
                time.sleep(600)
            return super().simulate(seed, progress)

    odd = Odd(**{field.name: getattr(TINY, field.name) for field in dataclasses.fields(TINY)})
    runs = dict(simulate_all(odd, [(6,), (7,)], 2))
    assert [runs[index].attributes["seed"] for index in (0, 1)] == [seed_of_draw((6,), 0), seed_of_draw((7,), 1)]
    assert "Another seed takes the place of" in caplog.text
    with pytest.raises(UnstableError, match="5 seeds in a row are unstable"):
        list(simulate_all(odd, [(9,), (5,)], 2))
    with pytest.raises(DataError, match="A process that simulates has ended: was it killed, or is memory short"):
        list(simulate_all(odd, [(9,), (8,)], 2))


@pytest.mark.parametrize("how", ["killed", "Ctrl-C"])
def test_processes_end_with_their_parent_and_write_nothing_more(tmp_path, how):
    words = [sys.executable, "-c", SCRIPT, json.dumps(ENDLESS.to_dict()), str(tmp_path / "made"), json.dumps(COUNTS)]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, process_group=0)
    try:
        wait_until(lambda: len(workers_of(process)) == 2)
        pids = workers_of(process)
        time.sleep(1)
        if how == "killed":
            process.kill()
            process.wait()
            wait_until(lambda: not running(pids), seconds=30)
        else:
            os.killpg(process.pid, signal.SIGINT)
            _, text = process.communicate(timeout=30)
            assert process.returncode != 0
            assert text.count("Traceback (most recent call last)") == 1, text  # the script's own
            assert not running(pids)
        assert not list(tmp_path.glob("made/.parts/*.npz"))
    finally:
        process.kill()
        process.communicate()
