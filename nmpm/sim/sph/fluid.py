"""The fluid of WCSPH: its parameters, and its particles while they move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nmpm.sim.arrays import Array
from nmpm.sim.config import check


@dataclass(frozen=True)
class Fluid:
    """Parameters of a weakly compressible fluid.

    Args:
        density: At rest, in kg / m².
        speed_of_sound: In m / s; ten times the fastest flow keeps density within one per cent.
        exponent: Of Tait's equation, p = ρ₀ c² / γ ((ρ / ρ₀)^γ − 1).
        alpha: Artificial viscosity; it amounts to a kinematic viscosity of α h c / 8.
        viscosity: Dynamic, in Pa s, which also brakes the fluid at walls; 0 lets it slip.
        diffusion: Of density, δ, which smooths what is uneven from particle to particle; 0.1 is usual.

    Raises:
        ConfigError: if a number is out of range.
    """

    density: float
    speed_of_sound: float
    exponent: float
    alpha: float
    viscosity: float
    diffusion: float

    def __post_init__(self) -> None:
        for key in ("density", "speed_of_sound", "exponent"):
            check(getattr(self, key) > 0, f"{key} = {getattr(self, key)} must be positive.")
        for key in ("alpha", "viscosity", "diffusion"):
            check(getattr(self, key) >= 0, f"{key} = {getattr(self, key)} must not be negative.")

    def kinematic_viscosity(self, spacing: float) -> float:
        """Artificial and physical viscosity together, in m² / s."""
        return self.alpha * spacing * self.speed_of_sound / 8 + self.viscosity / self.density


class SphParticles:
    """N moving particles; they are sorted by cell now and then, and given back in the first order.

    Args:
        position: (N, 2) in length.
        velocity: (N, 2) in length per second.
        density: Of all particles, at the start.
    """

    def __init__(self, position: NDArray[np.floating], velocity: NDArray[np.floating], density: float) -> None:
        self.table: Array = np.zeros((7, len(position)))
        self.table[0:2], self.table[2:4], self.table[4] = position.T, velocity.T, density
        self.identity: NDArray[np.int64] = np.arange(len(position))
        """(N,) index that each particle had at the start."""

    def sort(self, order: NDArray[np.int64]) -> None:
        """Reorder the particles."""
        self.table[:] = self.table[:, order]
        self.identity = self.identity[order]

    @property
    def position(self) -> Array:
        """(N, 2) in the first order."""
        return self._in_first_order(slice(0, 2))

    @property
    def velocity(self) -> Array:
        """(N, 2) in the first order."""
        return self._in_first_order(slice(2, 4))

    @property
    def density(self) -> Array:
        """(N,) in the first order."""
        return self._in_first_order(slice(4, 5))[:, 0]

    def _in_first_order(self, rows: slice) -> Array:
        ordered = np.empty((self.table.shape[1], rows.stop - rows.start))
        ordered[self.identity] = self.table[rows].T
        return ordered
