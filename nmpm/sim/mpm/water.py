"""Water: a weakly compressible fluid whose pressure follows from its compression alone, in any dimension.

With J the volume of a particle over its volume at rest, Tait's equation in Murnaghan's form gives the pressure

    p = K / γ · (J^−γ − 1),        c² = K / ρ at rest,

and the Kirchhoff stress is −J p I. Viscosity adds 2 η J times the deviator of the strain rate. J follows the flow by
dJ/dt = J ∇·v, so that a rotation leaves it alone whatever the length of the substep.

Where J > 1 the pressure is below zero: a share `tension` of it is kept. Murnaghan's own (1) levels off at K / γ for
γ > 0 and holds a splash together; with none (0) drops part freely. J is not reset when particles part: the
volume gained while torn must be lost again before water pushes back, as with sand.

Murnaghan, "The compressibility of media under extreme pressures", 1944; in the material point method: Tampubolon et
al., "Multi-species simulation of porous sand and water mixtures", 2017.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from nmpm._support.jit import jit
from nmpm.sim.mpm.material import Material
from nmpm.sim.state import Array, check, check_numbers

# Of the volume at rest: smaller, Tait's pressure would overflow. Stable simulations stay far above it.
_LEAST_VOLUME = 0.1


@dataclass(frozen=True)
class Water(Material):
    """Weakly compressible water.

    Args:
        density: Mass per area (per volume in 3-D), in kg / m² (kg / m³).
        bulk_modulus: K, stiffness against compression at rest, in Pa.
        exponent: γ; 7 is water's, −1 makes pressure linear in J.
        viscosity: η, shear stress per shear rate, in Pa s.
        tension: Share of the pressure below zero that is kept, from 0 to 1.
    """

    name: ClassVar[str] = "water"
    particle_type: ClassVar[int] = 5

    density: float
    bulk_modulus: float
    exponent: float = 7.0
    viscosity: float = 0.0
    tension: float = 1.0

    def __post_init__(self) -> None:
        check_numbers(self, "water.", positive=("density", "bulk_modulus"), at_least_0=("viscosity", "tension"))
        check(self.tension <= 1, f"water.tension = {self.tension} must be from 0 to 1.")
        exponent = self.exponent
        check(
            -1 <= exponent < math.inf and exponent != 0, f"water.exponent = {exponent} must be at least -1 and not 0."
        )

    @property
    def wave_speed(self) -> float:
        return math.sqrt(self.bulk_modulus / self.density)

    def bulk_stiffness(self, energy: float) -> float:
        """K / γ · ((γ − 1) J^(1−γ) + J), or K where that is less, with J compressed by the energy."""
        volume = self._compressed_volume(energy)
        exponent = self.exponent
        stiffness = self.bulk_modulus / exponent * ((exponent - 1) * volume ** (1 - exponent) + volume)
        return float(max(self.bulk_modulus, stiffness))

    def _compressed_volume(self, energy: float) -> float:
        """Smallest J that the energy can compress to: the root of ∫ p dV = energy, by bisection in [0.1, 1]."""
        low, high = _LEAST_VOLUME, 1.0
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if self._work(middle) > energy else (low, middle)
        return high

    def _work(self, volume: float) -> float:
        """Work that compresses it from rest to J, per volume at rest."""
        exponent = self.exponent
        power = -math.log(volume) if exponent == 1 else (volume ** (1 - exponent) - 1) / (exponent - 1)
        return float(self.bulk_modulus / exponent * (power - (1 - volume)))

    def rest(self, dim: int) -> tuple[float, ...]:  # noqa: ARG002
        return (1.0,)

    def pressure(self, volume: float) -> float:
        """At a volume J over the volume at rest, in Pa."""
        return _pressure(volume, self.bulk_modulus, self.exponent, self.tension)

    def respond(self, strain: Array, gradient: Array, stress: Array, dt: float) -> None:
        _compress(strain, gradient, stress, dt, self.bulk_modulus, self.exponent, self.tension)
        if self.viscosity > 0:
            _shear(strain, gradient, stress, self.viscosity)


@jit
def _pressure(volume: float, bulk_modulus: float, exponent: float, tension: float) -> float:
    if volume > 1:
        return tension * bulk_modulus / exponent * (math.exp(-exponent * math.log(volume)) - 1) if tension > 0 else 0.0
    return bulk_modulus / exponent * (math.exp(-exponent * math.log(volume)) - 1)


@jit
def _compress(
    strain: Array,
    gradient: Array,
    stress: Array,
    dt: float,
    bulk_modulus: float,
    exponent: float,
    tension: float,
) -> None:
    dim = gradient.shape[1]
    for p in range(strain.shape[0]):
        divergence = 0.0
        for i in range(dim):
            divergence += gradient[p, i, i]
        volume = strain[p, 0] * (1 + dt * divergence)
        # Written so that NaN stays NaN, and is found.
        if volume < _LEAST_VOLUME:
            volume = _LEAST_VOLUME
        strain[p, 0] = volume
        push = -volume * _pressure(volume, bulk_modulus, exponent, tension)
        k = 0
        for i in range(dim):
            stress[p, k] = push
            for j in range(k + 1, k + dim - i):
                stress[p, j] = 0.0
            k += dim - i


@jit
def _shear(strain: Array, gradient: Array, stress: Array, viscosity: float) -> None:
    """Adds the viscous stress."""
    dim = gradient.shape[1]
    for p in range(strain.shape[0]):
        mean = 0.0
        for i in range(dim):
            mean += gradient[p, i, i] / dim
        scale = viscosity * strain[p, 0]
        k = 0
        for i in range(dim):
            stress[p, k] += 2 * scale * (gradient[p, i, i] - mean)
            for j in range(i + 1, dim):
                stress[p, k + j - i] += scale * (gradient[p, i, j] + gradient[p, j, i])
            k += dim - i
