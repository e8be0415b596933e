"""What a training of several processes does where one of them has ended."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence


def is_lost_connection(error: RuntimeError) -> bool:
    """Whether a collective failed as another rank had ended, as far as the error's text tells."""
    return bool(re.search(r"gloo|NCCL|connection (was )?(closed|reset|refused)|broken pipe", str(error), re.IGNORECASE))


class RankWatch:
    """Says which rank has ended, and ends this process where it does not end by itself within a time.

    With gloo, collectives fail at once where a rank is gone. With NCCL they wait for it for ten minutes or longer, and
    no signal reaches the thread that waits.

    Args:
        rank: Of this process. All but rank 0 end with the process that started them.
        children: Gives rank 0's child processes, ranks 1 and up, once they are started; none on other ranks.
        advice: Says how to go on.
        patience: Seconds from the other rank's end to this one's.
    """

    def __init__(
        self,
        rank: int,
        children: Callable[[], Sequence[subprocess.Popen[bytes]]],
        advice: Callable[[], str],
        patience: float = 20.0,
    ) -> None:
        self._rank, self._children, self._advice, self._patience = rank, children, advice, patience
        self._parent, self._stopped = os.getppid(), threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def stop(self) -> None:
        """Watch no longer."""
        self._stopped.set()

    def line(self) -> str:
        """Names the rank that has ended, within 2 seconds, and how to go on; "" on ranks that leave it to another."""
        if self._rank == 0:
            return f"{self._describe_ended_child()}: {self._advice()}"
        has_ended = self._rank == 1 and self._lost_parent
        return f"rank 0 (process {self._parent}) has ended: {self._advice()}" if has_ended else ""

    def _describe_ended_child(self) -> str:
        end = time.monotonic() + 2.0
        while (children := self._children()) and time.monotonic() < end:
            for rank, process in enumerate(children, 1):
                if status := process.poll():
                    how = (
                        f"was killed by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
                    )
                    return f"rank {rank} (process {process.pid}) {how}"
            time.sleep(0.01)
        return "another rank has ended or cannot be reached"

    @property
    def _lost_parent(self) -> bool:
        return self._rank > 0 and os.getppid() != self._parent

    def _watch(self) -> None:
        while not (self._lost_parent or any(child.poll() for child in self._children())):
            if self._children():
                _dismiss_observer()
            if self._stopped.wait(0.5):
                return
        if not self._stopped.wait(self._patience):
            if line := self.line():
                sys.stderr.write(f"nmpm fit: {line}\n")
                sys.stderr.flush()
            for child in self._children():
                child.kill()
            os._exit(1)


def _dismiss_observer() -> None:
    """Take all ranks from Lightning's observer thread, which would kill rank 0 without a message once another ends."""
    for thread in threading.enumerate():
        if thread.name == "child-process-observer":
            thread._child_processes = []  # type: ignore[attr-defined]
