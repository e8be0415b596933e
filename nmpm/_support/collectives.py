"""Collectives: operations over all processes (ranks) of a training, so that W ranks train as one with W batches.

In a single process they are no-ops. In several, every rank must call them, in the same order.
"""

from __future__ import annotations

from collections.abc import Callable
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
