"""Tell which rank of a training has ended, where a collective of the others fails."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time

from lightning.pytorch import Trainer

from nmpm.errors import NmpmError

CONNECTION = re.compile(r"gloo|NCCL|connection (was )?(closed|reset|refused)|broken pipe", re.IGNORECASE)
SECONDS = 2.0
"""Within which a process that has closed its connections has ended."""


class LostRankError(NmpmError):
    """Another process of the training has ended."""


def is_lost_connection(error: RuntimeError) -> bool:
    """Whether a collective failed as another rank had ended, as far as the error's text tells."""
    return bool(CONNECTION.search(str(error)))


def lost_rank(trainer: Trainer, parent: int) -> str:
    """Which rank has ended, and how, in words; only that one has, where this process has not started it.

    Args:
        trainer: Whose collective failed.
        parent: The process that started this one, as of then.

    Returns:
        The words; none where another rank says them.
    """
    if trainer.global_rank > 0:
        ended = trainer.global_rank == 1 and os.getppid() != parent
        return f"rank 0 (process {parent}) has ended" if ended else ""
    processes: list[subprocess.Popen[bytes]] = getattr(trainer.strategy.launcher, "procs", [])
    end = time.monotonic() + SECONDS
    while processes and time.monotonic() < end:
        for rank, process in enumerate(processes, 1):
            if status := process.poll():
                how = f"was killed by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
                return f"rank {rank} (process {process.pid}) {how}"
        time.sleep(0.01)
    return "another rank has ended or cannot be reached"
