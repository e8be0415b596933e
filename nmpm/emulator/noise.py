"""What a stochastic processor reads in the calls of a rollout."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like
from nmpm.emulator.bundle import RolloutContext
from nmpm.emulator.model import Emulator


class Noise:
    """Draws for each scene from a generator of its own, so that its rollout does not depend on the batch.

    Args:
        emulator: Whose processor reads them.
        seeds: Of the scenes of a batch.
    """

    def __init__(self, emulator: Emulator, seeds: Sequence[int]) -> None:
        self._shape = (emulator.processor.noise, *emulator.grid.shape)
        self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def in_context(self, context: RolloutContext, scenes: Sequence[int]) -> RolloutContext:
        """The context of the next call, of some of the scenes; a processor without noise leaves it as it is."""
        if not self._shape[0]:
            return context
        drawn = torch.stack([torch.randn(self._shape, generator=self._generators[scene]) for scene in scenes])
        return dataclasses.replace(context, noise=drawn.to(context.solid.device))


def training_noise(emulator: Emulator, scenes: int, members: int, calls: int) -> Tensor | None:
    """(B, M, calls, Z, *S) for a training step of M >= 2 members, from torch's random state; None for one member.

    Each of several processes gets its rows of the numbers drawn for all.
    """
    if members == 1:
        return None
    shape = (scenes, members, calls, emulator.processor.noise, *emulator.grid.shape)
    return normal_like(torch.empty(shape, device=emulator.device))
