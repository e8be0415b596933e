"""Decoders: how the processor's grid output becomes the particles' velocities within a bundle.

For frame i = 1 … m of a bundle the velocity is

    v_i = known_i + g2p(output_i)(x_{i-1})

and a decoder gives the part known without the network, which need not be learnt.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.errors import ConfigError


class Decoder(ABC):
    """The known part of a bundle's velocities. Subclasses are stateless; all quantities in grid units."""

    @abstractmethod
    def carried_velocity(self, own: Tensor, smoothed: Tensor) -> Tensor:
        """The velocity (B, N, D) that the bundle starts from.

        Args:
            own: (B, N, D) the particles' own velocities at the bundle's start.
            smoothed: (B, N, D) the grid's velocity, gathered at their starting positions.
        """

    @abstractmethod
    def known_velocity(self, carried: Tensor, previous: Tensor, gravity: Tensor, frame: int) -> Tensor:
        """The velocity (B, N, D) that is known for a frame.

        Args:
            carried: (B, N, D), from `carried_velocity`.
            previous: (B, N, D) velocity of the frame before, `carried` for the first.
            gravity: (B, 1, D) known acceleration.
            frame: 1 … m.
        """


class _Ballistic(Decoder):
    """Decoders that keep the bundle's initial velocity, accelerated by known gravity."""

    def known_velocity(self, carried: Tensor, previous: Tensor, gravity: Tensor, frame: int) -> Tensor:  # noqa: ARG002
        return torch.add(carried, gravity, alpha=frame)


@dataclass(frozen=True)
class Absolute(Decoder):
    """The paper's form: the network gives the whole velocity, v_i = g2p(output_i). Source: arXiv 2408.15753, eq. 5."""

    def carried_velocity(self, own: Tensor, smoothed: Tensor) -> Tensor:  # noqa: ARG002 (nothing is known)
        return torch.zeros_like(own)

    def known_velocity(self, carried: Tensor, previous: Tensor, gravity: Tensor, frame: int) -> Tensor:  # noqa: ARG002
        return carried


@dataclass(frozen=True)
class Residual(_Ballistic):
    """The network gives increments to the grid's current velocity u: v_i = u + i g + g2p(output_i)."""

    def carried_velocity(self, own: Tensor, smoothed: Tensor) -> Tensor:  # noqa: ARG002
        return smoothed


@dataclass(frozen=True)
class Flip(_Ballistic):
    """The network gives increments to each particle's own velocity: v_i = v_0 + i g + g2p(output_i).

    Source: Brackbill & Ruppel, FLIP, J. Comput. Phys. 65 (1986): less smoothing than `Residual`, more noise.
    """

    def carried_velocity(self, own: Tensor, smoothed: Tensor) -> Tensor:  # noqa: ARG002
        return own


@dataclass(frozen=True)
class Blend(_Ballistic):
    """Between `Residual` and `Flip`: v_0 is mixed from each particle's own velocity and the grid's.

    Source: Zhu & Bridson, Animating sand as a fluid, SIGGRAPH 2005: a little smoothing takes FLIP's noise away.

    Args:
        flip: Share of the particle's own velocity, from 0 to 1.

    Raises:
        ConfigError: if it is not within 0 and 1.
    """

    flip: float = 0.95

    def __post_init__(self) -> None:
        if not 0 <= self.flip <= 1:
            raise ConfigError(f"Blend.flip = {self.flip} must be from 0 to 1.")

    def carried_velocity(self, own: Tensor, smoothed: Tensor) -> Tensor:
        return self.flip * own + (1 - self.flip) * smoothed


@dataclass(frozen=True)
class Acceleration(Decoder):
    """The network gives accelerations beside the known gravity: v_i = v_{i-1} + g + g2p(output_i), v_0 the grid's.

    Each frame's output acts where the particle is by then and stays with it, as forces do.
    """

    def carried_velocity(self, own: Tensor, smoothed: Tensor) -> Tensor:  # noqa: ARG002
        return smoothed

    def known_velocity(self, carried: Tensor, previous: Tensor, gravity: Tensor, frame: int) -> Tensor:  # noqa: ARG002
        return previous + gravity
