"""Sand: elastic grains that slide where shear exceeds friction (Drucker-Prager), and come apart without resistance.

With b the elastic left Cauchy-Green strain, J² = det b, and ε₁ ≥ ε₂ half the logarithms of its eigenvalues (the Hencky
strains), plane strain gives the Kirchhoff stress

    τ = (λ + μ) ln J · I + 2 μ e · n,    e = (ε₁ − ε₂) / 2,

where n is the deviator of b scaled to eigenvalues ±1. After each substep the sand is

- apart if J ≥ 1: no stress, and the deviator is dropped;
- at rest if 2 μ e ≤ −(λ + μ) ln J · sin φ: shear stress over pressure is at most the sine of the friction angle φ,
  which is Mohr and Coulomb's law in plane strain;
- else sliding: e returns to that bound with J as it is, so that sliding makes no volume.

The volume gained while apart stays in J and must be lost again before grains touch, or heaps would swell with every
stir: Klár et al., "Drucker-Prager elastoplasticity for sand animation", 2016, for the return in principal strains,
and Tampubolon et al., "Multi-species simulation of porous sand and water mixtures", 2017, for the volume. They keep
that volume in a number of its own, and match the cone to triaxial tests, which makes it up to 8% lower.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from nmpm._support.jit import jit
from nmpm.errors import ConfigError
from nmpm.sim.arrays import Array
from nmpm.sim.mpm.materials.elastic import PlaneStrainSolid


@dataclass(frozen=True)
class Sand(PlaneStrainSolid):
    """Dry sand in two dimensions.

    Args:
        density: Mass per area, in kg / m².
        young: Young's modulus, in Pa.
        poisson: Poisson's ratio, between 0 and 0.5.
        friction_angle: φ, between 0 and 90 degrees.

    Raises:
        ConfigError: if a parameter is out of its range.
    """

    name: ClassVar[str] = "sand"
    particle_type: ClassVar[int] = 6

    friction_angle: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.friction_angle < 90:
            raise ConfigError(f"sand.friction_angle = {self.friction_angle} must be at least 0 and below 90 degrees.")

    def respond(self, strain: Array, gradient: Array, stress: Array, dt: float) -> None:
        friction = math.sin(math.radians(self.friction_angle))
        _respond(strain, gradient, stress, dt, self.shear_modulus, self.bulk_modulus, friction)


@jit
def _respond(
    strain: Array,
    gradient: Array,
    stress: Array,
    dt: float,
    shear_modulus: float,
    bulk_modulus: float,
    friction: float,
) -> None:
    for p in range(strain.shape[0]):
        a, b = 1 + dt * gradient[p, 0, 0], dt * gradient[p, 0, 1]
        c, d = dt * gradient[p, 1, 0], 1 + dt * gradient[p, 1, 1]
        xx, xy, yy = strain[p, 0], strain[p, 1], strain[p, 2]
        xx, xy, yy = (
            a * a * xx + 2 * a * b * xy + b * b * yy,
            a * c * xx + (a * d + b * c) * xy + b * d * yy,
            c * c * xx + 2 * c * d * xy + d * d * yy,
        )
        area = math.sqrt(xx * yy - xy * xy)
        if area >= 1:
            strain[p, 0], strain[p, 1], strain[p, 2] = area, 0.0, area
            stress[p, 0] = stress[p, 1] = stress[p, 2] = 0.0
            continue
        mean, half = (xx + yy) / 2, (xx - yy) / 2
        radius = math.sqrt(half * half + xy * xy)
        # With no deviator there is no direction, and any will do.
        along, across = (half / radius, xy / radius) if radius > 0 else (1.0, 0.0)
        pressure = -bulk_modulus * math.log(area)
        deviator = math.log((mean + radius) / area) / 2
        bound = friction * pressure / (2 * shear_modulus)
        if deviator > bound:
            deviator = bound
            stretch = math.exp(2 * deviator)
            mean, radius = area * (stretch + 1 / stretch) / 2, area * (stretch - 1 / stretch) / 2
            xx, xy, yy = mean + radius * along, radius * across, mean - radius * along
        strain[p, 0], strain[p, 1], strain[p, 2] = xx, xy, yy
        shear = 2 * shear_modulus * deviator
        stress[p, 0] = shear * along - pressure
        stress[p, 1] = shear * across
        stress[p, 2] = -shear * along - pressure
