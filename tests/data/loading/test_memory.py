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


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits the memory of a process as Linux does")
def test_memory_is_bounded_by_the_buffer(tmp_path):
    start = np.random.default_rng(0).uniform(0.2, 0.8, (1, PARTICLES, 2))
    position = np.broadcast_to(start, (FRAMES, PARTICLES, 2)).astype(np.float32)
    assert TRAJECTORIES * position.nbytes > 1.9 * ALLOWED
    write_split(tmp_path / "train.h5", (Trajectory(position, np.full(PARTICLES, 7)) for _ in range(TRAJECTORIES)))
    facts = Metadata(((0.1, 0.9),) * 2, 0.0025, 2, FRAMES, {7: "goop"}, gravity=(0.0, -9.81))
    write_metadata(tmp_path, facts)
    runs = [
        subprocess.run(
            [sys.executable, "-c", STREAMING, str(tmp_path), str(ALLOWED), str(size)],
            capture_output=True, text=True, timeout=120, check=False,
        )
        for size in (2, TRAJECTORIES)
    ]  # fmt: skip
    assert runs[0].stdout.strip() == "240", runs[0].stderr[-2000:]
    assert runs[1].returncode != 0
    lacking = ("MemoryError", "alloc", "filter returned failure")  # the last is HDF5's word where a filter gets none
    assert any(words in runs[1].stderr for words in lacking), runs[1].stderr[-2000:]
