"""Materials of the material point method: how stress follows from the motion so far.

*Water* is a weakly compressible fluid whose pressure follows from its compression alone, in any dimension. With J the
volume of a particle over its volume at rest, Tait's equation in Murnaghan's form gives the pressure

    p = K / γ · (J^−γ − 1),        c² = K / ρ at rest,

and the Kirchhoff stress is −J p I. Viscosity adds 2 η J times the deviator of the strain rate. J follows the flow by
dJ/dt = J ∇·v, so that a rotation leaves it alone whatever the length of the substep.

Where J > 1 the pressure is below zero: a share `tension` of it is kept. Murnaghan's own (1) levels off at K / γ for
γ > 0 and holds a splash together; with none (0) drops part freely. J is not reset when particles part: the
volume gained while torn must be lost again before water pushes back, as with sand.

Murnaghan, "The compressibility of media under extreme pressures", 1944; in the material point method: Tampubolon et
al., "Multi-species simulation of porous sand and water mixtures", 2017.

*Sand and goop* are elastic solids in plane strain whose plastic flow returns the strain to a bound. With b the elastic
left Cauchy-Green strain, J² = det b, and ε₁ ≥ ε₂ half the logarithms of its eigenvalues (the Hencky strains), plane
strain gives the Kirchhoff stress

    τ = (λ + μ) ln J · I + 2 μ e · n,    e = (ε₁ − ε₂) / 2,

where n is the deviator of b scaled to eigenvalues ±1. Plastic flow changes e and leaves J alone (return in principal
strains: Klár et al., "Drucker-Prager elastoplasticity for sand animation", 2016).

*Sand*, elastic grains that slide where shear exceeds friction (Drucker-Prager), is after each substep

- apart if J ≥ 1: no stress, and the deviator is dropped;
- at rest if 2 μ e ≤ −(λ + μ) ln J · sin φ: shear stress over pressure is at most the sine of the friction angle φ,
  which is Mohr and Coulomb's law in plane strain;
- else sliding: e returns to that bound with J as it is, so that sliding makes no volume.

The volume gained while apart stays in J and must be lost again before grains touch, or heaps would swell with every
stir (Tampubolon et al., "Multi-species simulation of porous sand and water mixtures", 2017, who keep that volume in a
number of its own). Both papers match the cone to triaxial tests, which makes it up to 8% lower.

*Goop*, a paste, is solid below its yield stress τ_y and a viscous liquid above it: its shear stress relaxes by

    de/dt = −⟨2 μ e − τ_y⟩ / (2 η),

solved exactly over a substep. In steady shear at rate γ it reads τ_y + η γ: a Bingham fluid (over-stress
viscoplasticity: Perzyna, "Fundamental problems in viscoplasticity", 1966).
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import ClassVar

from nmpm._support.jit import jit
from nmpm.errors import ConfigError
from nmpm.sim.state import Array, check, check_numbers


class Material(abc.ABC):
    """A constitutive model: how stress follows from the motion so far.

    The simulator stores a few numbers per particle for it, its strain, which only the material interprets.
    Symmetric tensors are written as their upper triangle row by row: (xx, xy, yy), (xx, xy, xz, yy, yz, zz).
    """

    name: ClassVar[str]
    particle_type: ClassVar[int]
    """Type id in the files, as in DeepMind's scenes."""

    density: float
    """Mass per area at rest, in kg / m²."""

    @property
    @abc.abstractmethod
    def wave_speed(self) -> float:
        """Speed of the fastest elastic wave at rest, in length per second."""

    @abc.abstractmethod
    def bulk_stiffness(self, energy: float) -> float:
        """Largest stiffness against compression, −d(J p) / d ln J in Pa, up to where an energy can compress it.

        J is a particle's volume over its volume at rest, and p its pressure; the energy is per volume at rest.
        """

    @abc.abstractmethod
    def rest(self, dim: int) -> tuple[float, ...]:
        """Strain of an unstrained particle in D dimensions; its length is the number of components."""

    @abc.abstractmethod
    def respond(self, strain: Array, gradient: Array, stress: Array, dt: float) -> None:
        """Update the strain by one substep, in place, and write the stress that it causes.

        Args:
            strain: (N, S) strain, S at least the length of `rest(D)`; further columns are other materials'.
            gradient: (N, D, D) velocity gradient, d v_i / d x_j, per second.
            stress: (N, D (D + 1) / 2) Kirchhoff stress, in Pa; overwritten.
            dt: Length of the substep, in seconds.
        """


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


@dataclass(frozen=True)
class PlaneStrainSolid(Material):
    """An elastic solid in two dimensions; subclasses add plastic flow.

    Args:
        density: Mass per area, in kg / m².
        young: Young's modulus, in Pa.
        poisson: Poisson's ratio, between 0 and 0.5.
    """

    density: float
    young: float
    poisson: float

    def __post_init__(self) -> None:
        check_numbers(self, f"{self.name}.", positive=("density", "young"), at_least_0=("poisson",))
        check(self.poisson < 0.5, f"{self.name}.poisson = {self.poisson} must be below 0.5.")

    @property
    def shear_modulus(self) -> float:
        """μ, in Pa."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def bulk_modulus(self) -> float:
        """λ + μ, the stiffness against a change of area in plane strain, in Pa."""
        return self.shear_modulus / (1 - 2 * self.poisson)

    @property
    def moduli(self) -> tuple[float, float]:
        """`shear_modulus` and `bulk_modulus`."""
        return self.shear_modulus, self.bulk_modulus

    @property
    def wave_speed(self) -> float:
        return math.sqrt((self.bulk_modulus + self.shear_modulus) / self.density)

    def bulk_stiffness(self, energy: float) -> float:  # noqa: ARG002  # (the law is linear in Hencky's strains)
        return self.bulk_modulus

    def rest(self, dim: int) -> tuple[float, ...]:
        if dim != 2:
            raise ConfigError(f"{self.name} is implemented in two dimensions, not in {dim}.")
        return 1.0, 0.0, 1.0


@dataclass(frozen=True)
class Sand(PlaneStrainSolid):
    """Dry sand in two dimensions.

    Arguments beside those of `PlaneStrainSolid`:

    Args:
        friction_angle: φ, between 0 and 90 degrees.
    """

    name: ClassVar[str] = "sand"
    particle_type: ClassVar[int] = 6

    friction_angle: float

    def __post_init__(self) -> None:
        super().__post_init__()
        angle = self.friction_angle
        check(0 <= angle < 90, f"sand.friction_angle = {angle} must be at least 0 and below 90 degrees.")

    def respond(self, strain: Array, gradient: Array, stress: Array, dt: float) -> None:
        friction = math.sin(math.radians(self.friction_angle))
        _flow(strain, gradient, stress, dt, self.moduli, friction, 0.0, 0.0, True)


@dataclass(frozen=True)
class Goop(PlaneStrainSolid):
    """Elasto-viscoplastic goop.

    Arguments beside those of `PlaneStrainSolid`:

    Args:
        yield_stress: Shear stress below which it does not flow, in Pa.
        viscosity: Shear stress above the yield stress per shear rate, in Pa s.
    """

    name: ClassVar[str] = "goop"
    particle_type: ClassVar[int] = 7

    yield_stress: float
    viscosity: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, "goop.", positive=("viscosity",), at_least_0=("yield_stress",))

    def respond(self, strain: Array, gradient: Array, stress: Array, dt: float) -> None:
        remaining = math.exp(-self.shear_modulus * dt / self.viscosity)
        _flow(strain, gradient, stress, dt, self.moduli, 0.0, self.yield_stress, remaining, False)


@jit
def _stretch(strain: Array, gradient: Array, p: int, dt: float) -> tuple[float, float, float]:
    """A particle's strain (xx, xy, yy) after a substep without plastic flow."""
    a, b = 1 + dt * gradient[p, 0, 0], dt * gradient[p, 0, 1]
    c, d = dt * gradient[p, 1, 0], 1 + dt * gradient[p, 1, 1]
    xx, xy, yy = strain[p, 0], strain[p, 1], strain[p, 2]
    return (
        a * a * xx + 2 * a * b * xy + b * b * yy,
        a * c * xx + (a * d + b * c) * xy + b * d * yy,
        c * c * xx + 2 * c * d * xy + d * d * yy,
    )


@jit
def _principal(xx: float, xy: float, yy: float, area: float) -> tuple[float, float, float]:
    """Half the difference e of the Hencky strains, and the components (xx, xy) of the deviator n."""
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    radius = math.sqrt(half * half + xy * xy)
    # With no deviator there is no direction, and any will do.
    along, across = (half / radius, xy / radius) if radius > 0 else (1.0, 0.0)
    return math.log((mean + radius) / area) / 2, along, across


@jit
def _compose(area: float, deviator: float, along: float, across: float) -> tuple[float, float, float]:
    """The strain (xx, xy, yy) with these principal values."""
    stretch = math.exp(2 * deviator)
    mean, radius = area * (stretch + 1 / stretch) / 2, area * (stretch - 1 / stretch) / 2
    return mean + radius * along, radius * across, mean - radius * along


@jit
def _flow(
    strain: Array,
    gradient: Array,
    stress: Array,
    dt: float,
    moduli: tuple[float, float],
    friction: float,
    yield_stress: float,
    remaining: float,
    parts: bool,
) -> None:
    """A substep in which shear stress beyond `yield_stress` + `friction` × pressure falls to a share of `remaining`.

    A solid that `parts` bears no stress once its area is at least that at rest.
    """
    shear_modulus, bulk_modulus = moduli
    for p in range(strain.shape[0]):
        xx, xy, yy = _stretch(strain, gradient, p, dt)
        area = math.sqrt(xx * yy - xy * xy)
        if parts and area >= 1:
            strain[p, 0], strain[p, 1], strain[p, 2] = area, 0.0, area
            stress[p, 0] = stress[p, 1] = stress[p, 2] = 0.0
            continue
        pressure = -bulk_modulus * math.log(area)
        deviator, along, across = _principal(xx, xy, yy, area)
        bound = (yield_stress + friction * pressure) / (2 * shear_modulus)
        if deviator > bound:
            deviator = bound + remaining * (deviator - bound)
            xx, xy, yy = _compose(area, deviator, along, across)
        strain[p, 0], strain[p, 1], strain[p, 2] = xx, xy, yy
        shear = 2 * shear_modulus * deviator
        stress[p, 0] = shear * along - pressure
        stress[p, 1] = shear * across
        stress[p, 2] = -shear * along - pressure
