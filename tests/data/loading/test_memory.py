"""A dataset may be larger than the memory that there is."""

import subprocess
import sys

import numpy as np
import pytest

from nmpm.data.format import Metadata, Trajectory, write_metadata, write_split

TRAJECTORIES, FRAMES, PARTICLES = 80, 250, 2000  # 4 MB of positions each, 320 MB in all
ALLOWED = 160 * 2**20

STREAMING = """
import resource, sys
from itertools import islice
from nmpm.data.datamodule import TrajectoryDataModule

data = TrajectoryDataModule(
    path=sys.argv[1], horizon=8, batch_size=2, buffer_size=int(sys.argv[3]), passes=0.01, emphasis=0.5
)
loader = data.train_dataloader()
used = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmData:")) * 1024
resource.setrlimit(resource.RLIMIT_DATA, (used + int(sys.argv[2]),) * 2)
print(sum(len(window.frames) for window in islice(loader, 120)))
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("large")
    start = np.random.default_rng(0).uniform(0.2, 0.8, (1, PARTICLES, 2))
    position = np.broadcast_to(start, (FRAMES, PARTICLES, 2)).astype(np.float32)
    run = Trajectory(position, np.full(PARTICLES, 7))
    write_split(folder / "train.h5", (run for _ in range(TRAJECTORIES)))
    write_metadata(folder, Metadata(((0.1, 0.9),) * 2, 0.0025, 2, FRAMES, {7: "goop"}, gravity=(0.0, -9.81)))
    return folder


def stream(folder, buffer_size: int) -> subprocess.CompletedProcess:
    words = [sys.executable, "-c", STREAMING, str(folder), str(ALLOWED), str(buffer_size)]
    return subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits the memory of a process as Linux does")
def test_memory_is_bounded_by_the_buffer(dataset):
    assert TRAJECTORIES * FRAMES * PARTICLES * 8 > 1.9 * ALLOWED
    run = stream(dataset, buffer_size=2)
    assert run.stdout.strip() == "240", run.stderr[-2000:]
    whole = stream(dataset, buffer_size=TRAJECTORIES)
    assert whole.returncode != 0
    assert "MemoryError" in whole.stderr or "alloc" in whole.stderr
