"""Ranks that wait for one that has ended; what several ranks compute together is tested in `tests/training`."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

WAITING = """
import ctypes, os, subprocess, sys
from nmpm.training.rank_watch import RankWatch
processes = []
if sys.argv[1] == "0":
    processes += [subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"]) for _ in range(2)]
RankWatch(int(sys.argv[1]), lambda: processes, lambda: "go on", patience=0.5)
print(*([process.pid for process in processes] or [os.getppid()]), flush=True)
mutex = ctypes.create_string_buffer(64)
lock = ctypes.CDLL(None).pthread_mutex_lock
lock(mutex), lock(mutex)  # waits as a collective of a GPU does: no signal ends it
"""
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("rank", "line"),
    [(0, r"nmpm fit: rank 1 \(process \d+\) was killed by SIGKILL: go on\n"),
     (1, r"nmpm fit: rank 0 \(process \d+\) has ended: go on\n"), (2, "")],
)  # fmt: skip
def test_a_rank_that_waits_in_a_collective_ends_when_another_has(rank, line):
    command = [sys.executable, "-c", WAITING, str(rank)]
    if rank > 0:  # rank 0 has started it
        command = [sys.executable, "-c", f"import subprocess; subprocess.run({command!r})"]
    options = {"env": ENVIRONMENT, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **options) as process:
        killed, *others = map(int, process.stdout.readline().split())
        os.kill(killed, signal.SIGKILL)
        assert re.fullmatch(line, process.stderr.read())  # to its end: all processes that write to it have ended
        process.wait(timeout=60)
        assert not any(map(is_running, others))
