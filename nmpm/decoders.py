"""Decoders: how the processor's grid output becomes the particles' velocities within a bundle.

For frame i = 1 … m of a bundle the velocity is

    v_i = known_i + g2p(output_i)(x_{i-1})

and a decoder says what is known before the network has spoken. What is known need not be learnt.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor


class Decoder(ABC):
    """What is known of the velocities of a bundle. Subclasses are stateless; all quantities in grid units."""

    @abstractmethod
    def carried(self, own: Tensor, smoothed: Tensor) -> Tensor:
        """The velocity that the bundle starts from and holds.

        Args:
            own: (B, N, D) the particles' own velocities at the bundle's start.
            smoothed: (B, N, D) the grid's velocity, gathered at their starting positions.
        """

    @abstractmethod
    def gained(self, gravity: Tensor, frame: int) -> Tensor:
        """The velocity (B, D) that a known gravity (B, D) has added by `frame` (1 … m) of the bundle."""


@dataclass(frozen=True)
class Absolute(Decoder):
    """The paper's form: the network gives the whole velocity, v_i = g2p(output_i). Source: arXiv 2408.15753, eq. 5."""

    def carried(self, own: Tensor, smoothed: Tensor) -> Tensor:  # noqa: ARG002 (nothing is known)
        return torch.zeros_like(own)

    def gained(self, gravity: Tensor, frame: int) -> Tensor:  # noqa: ARG002
        return torch.zeros_like(gravity)


@dataclass(frozen=True)
class Residual(Decoder):
    """The network gives increments to the grid's current velocity u: v_i = u + i g + g2p(output_i)."""

    def carried(self, own: Tensor, smoothed: Tensor) -> Tensor:  # noqa: ARG002
        return smoothed

    def gained(self, gravity: Tensor, frame: int) -> Tensor:
        return gravity * frame


@dataclass(frozen=True)
class Flip(Decoder):
    """The network gives increments to each particle's own velocity: v_i = v_0 + i g + g2p(output_i).

    Source: Brackbill & Ruppel, FLIP, J. Comput. Phys. 65 (1986): less smoothing than `Residual`, more noise.
    """

    def carried(self, own: Tensor, smoothed: Tensor) -> Tensor:  # noqa: ARG002
        return own

    def gained(self, gravity: Tensor, frame: int) -> Tensor:
        return gravity * frame
