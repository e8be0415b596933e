"""What the processes of a training tell each other, so that together they do what one would with all of the batch.

Alone, a process tells nothing to anybody. Everything here that tells must be called by all processes, in one order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, distributed

T = TypeVar("T")


def place() -> tuple[int, int]:
    """This process's number, and how many there are."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def gathered(value: T) -> list[T]:
    """Everybody's values, in the order of their numbers, for everybody."""
    _, world = place()
    if world == 1:
        return [value]
    found: list[T | None] = [None] * world
    distributed.all_gather_object(found, value)
    return found  # type: ignore[return-value]  # (all are there now)


def collected(value: T) -> list[T]:
    """Everybody's values, in the order of their numbers, for process 0; nothing for the others."""
    rank, world = place()
    if world == 1:
        return [value]
    found: list[T | None] | None = [None] * world if rank == 0 else None
    distributed.gather_object(value, found)
    return found or []  # type: ignore[return-value]  # (likewise)


def of_the_first(value: float, device: torch.device) -> float:
    """The value of process 0.

    Args:
        value: This process's own.
        device: Where processes exchange tensors.
    """
    if place()[1] == 1:
        return value
    told = torch.tensor(value, dtype=torch.float64, device=device)
    distributed.broadcast(told, src=0)
    return float(told)


def of_all(mean: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """A mean over some particles of each process, as part of the mean over the particles of all processes.

    Nothing waits for the answer, so that a GPU is kept busy.

    Args:
        mean: () over this process's particles.
        count: () how many those are.

    Returns:
        () this process's part, in which gradients flow, and () the mean over the particles of all. The processes' parts
        have that as their mean, whatever their counts.
    """
    _, world = place()
    if world == 1:
        return mean, mean.detach()
    total = torch.stack([mean.detach().float() * count, count.float()])
    distributed.all_reduce(total)
    return mean * (world * count / total[1]), total[0] / total[1]


def share_of(draw: Callable[[int], Tensor], rows: int) -> Tensor:
    """This process's rows of random numbers that are drawn for all, which have the same random state and as many rows.

    Every process draws all of them, which costs little beside a step, and takes its own: one process with all of the
    rows would draw the same.

    Args:
        draw: Draws so many rows.
        rows: Rows of one process.
    """
    rank, world = place()
    return draw(world * rows)[rank * rows : (rank + 1) * rows]


def normal_like(values: Tensor) -> Tensor:
    """Normally distributed numbers for (B, …) values: this process's share of them, as `share_of` says."""
    _, world = place()
    if world == 1:
        return torch.randn_like(values)
    # Without memory of its own: the order in memory, and with it that of the numbers, is what counts.
    layout = torch.cat([values.to("meta")] * world)
    return share_of(lambda _: torch.randn_like(layout, device=values.device), len(values))
