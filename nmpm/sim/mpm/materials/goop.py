"""Goop: an elasto-viscoplastic paste, solid below its yield stress and a viscous liquid above it.

With b the elastic left Cauchy-Green strain, J² = det b, and ε₁ ≥ ε₂ half the logarithms of its eigenvalues (the Hencky
strains), plane strain gives the Kirchhoff stress

    τ = (λ + μ) ln J · I + 2 μ e · n,    e = (ε₁ − ε₂) / 2,

where n is the deviator of b scaled to eigenvalues ±1. The shear stress 2 μ e relaxes towards the yield stress τ_y,

    de/dt = −⟨2 μ e − τ_y⟩ / (2 η),

which is solved exactly over a substep and leaves J alone. In steady shear at rate γ it reads τ_y + η γ: a Bingham
fluid.
Hencky elasticity with a return in principal strains: Klár et al., "Drucker-Prager elastoplasticity for sand animation",
2016; over-stress viscoplasticity: Perzyna, "Fundamental problems in viscoplasticity", 1966.
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
class Goop(PlaneStrainSolid):
    """Elasto-viscoplastic goop.

    Args:
        density: Mass per area, in kg / m².
        young: Young's modulus, in Pa.
        poisson: Poisson's ratio, between 0 and 0.5.
        yield_stress: Shear stress below which it does not flow, in Pa.
        viscosity: Shear stress above the yield stress per shear rate, in Pa s.

    Raises:
        ConfigError: if a parameter is out of its range.
    """

    name: ClassVar[str] = "goop"
    particle_type: ClassVar[int] = 7

    yield_stress: float
    viscosity: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.viscosity < math.inf:
            raise ConfigError(f"goop.viscosity = {self.viscosity} must be positive and finite.")
        if not 0 <= self.yield_stress < math.inf:
            raise ConfigError(f"goop.yield_stress = {self.yield_stress} must not be negative.")

    def respond(self, strain: Array, gradient: Array, stress: Array, dt: float) -> None:
        remaining = math.exp(-self.shear_modulus * dt / self.viscosity)
        _respond(strain, gradient, stress, dt, self.shear_modulus, self.bulk_modulus, self.yield_stress, remaining)


@jit
def _respond(
    strain: Array,
    gradient: Array,
    stress: Array,
    dt: float,
    shear_modulus: float,
    bulk_modulus: float,
    yield_stress: float,
    remaining: float,
) -> None:
    yield_strain = yield_stress / (2 * shear_modulus)
    for p in range(strain.shape[0]):
        a, b = 1 + dt * gradient[p, 0, 0], dt * gradient[p, 0, 1]
        c, d = dt * gradient[p, 1, 0], 1 + dt * gradient[p, 1, 1]
        xx, xy, yy = strain[p, 0], strain[p, 1], strain[p, 2]
        xx, xy, yy = (
            a * a * xx + 2 * a * b * xy + b * b * yy,
            a * c * xx + (a * d + b * c) * xy + b * d * yy,
            c * c * xx + 2 * c * d * xy + d * d * yy,
        )
        mean, half = (xx + yy) / 2, (xx - yy) / 2
        radius = math.sqrt(half * half + xy * xy)
        area = math.sqrt(xx * yy - xy * xy)
        # With no deviator there is no direction, and any will do.
        along, across = (half / radius, xy / radius) if radius > 0 else (1.0, 0.0)
        deviator = math.log((mean + radius) / area) / 2
        if deviator > yield_strain:
            deviator = yield_strain + remaining * (deviator - yield_strain)
            stretch = math.exp(2 * deviator)
            mean, radius = area * (stretch + 1 / stretch) / 2, area * (stretch - 1 / stretch) / 2
            xx, xy, yy = mean + radius * along, radius * across, mean - radius * along
        strain[p, 0], strain[p, 1], strain[p, 2] = xx, xy, yy
        pressure, shear = bulk_modulus * math.log(area), 2 * shear_modulus * deviator
        stress[p, 0] = pressure + shear * along
        stress[p, 1] = shear * across
        stress[p, 2] = pressure - shear * along
