"""Collectives: operations over all processes (ranks) of a training, so that W ranks train as one with W batches.

In a single process they are no-ops. In several, every rank must call them, in the same order.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, distributed

T = TypeVar("T")


def rank_and_world_size() -> tuple[int, int]:
    """This process's rank, and how many processes there are; (0, 1) where nothing is distributed."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def all_gather(value: T) -> list[T]:
    """The values of all ranks, in the order of ranks, on every rank (`all_gather_object`)."""
    _, world = rank_and_world_size()
    if world == 1:
        return [value]
    values: list[T | None] = [None] * world
    distributed.all_gather_object(values, value)
    return values  # type: ignore[return-value]  # (every rank has set its own)


def gather_to_rank0(value: T) -> list[T]:
    """The values of all ranks, in the order of ranks, on rank 0; an empty list elsewhere (`gather_object`)."""
    rank, world = rank_and_world_size()
    if world == 1:
        return [value]
    values: list[T | None] | None = [None] * world if rank == 0 else None
    distributed.gather_object(value, values)
    return values or []  # type: ignore[return-value]  # (likewise)


def global_mean(mean: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """A mean over this rank's `count` particles as part of the mean over those of all ranks (`all_reduce`).

    Returns:
        () this rank's part, in which gradients flow, and () the mean over all particles, which the parts' mean over
        ranks is, whatever the counts. Nothing is read back from the device.
    """
    _, world = rank_and_world_size()
    if world == 1:
        return mean, mean.detach()
    total = torch.stack([mean.detach().float() * count, count.float()])
    distributed.all_reduce(total)
    return mean * (world * count / total[1]), total[0] / total[1]


def rank_slice(draw: Callable[[int], Tensor], rows: int) -> Tensor:
    """This rank's rows of random numbers that are drawn for all ranks, which share a random state and a batch size.

    One process with all rows would draw the same.
    """
    rank, world = rank_and_world_size()
    return draw(world * rows)[rank * rows : (rank + 1) * rows]


def normal_like(values: Tensor) -> Tensor:
    """Normally distributed numbers for (B, …) values: this rank's rows of those drawn for all ranks."""
    _, world = rank_and_world_size()
    if world == 1:
        return torch.randn_like(values)
    # A meta tensor has no memory, but a memory order, which decides the order of the numbers drawn.
    layout = torch.cat([values.to("meta")] * world)
    return rank_slice(lambda _: torch.randn_like(layout, device=values.device), len(values))


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
