"""What elastic solids in plane strain have in common: their moduli, and the strain that they keep.

The strain is the elastic left Cauchy-Green strain b, (xx, xy, yy); with Hencky's strains, half the logarithms of its
eigenvalues, the law is linear, and plastic flow returns them to a bound (Klár et al., "Drucker-Prager elastoplasticity
for sand animation", 2016).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from nmpm.errors import ConfigError
from nmpm.sim.mpm.materials.base import Material


@dataclass(frozen=True)
class PlaneStrainSolid(Material):
    """An elastic solid in two dimensions; subclasses add plastic flow.

    Args:
        density: Mass per area, in kg / m².
        young: Young's modulus, in Pa.
        poisson: Poisson's ratio, between 0 and 0.5.

    Raises:
        ConfigError: if a parameter is out of its range.
    """

    density: float
    young: float
    poisson: float

    def __post_init__(self) -> None:
        for key in ("density", "young"):
            if not 0 < getattr(self, key) < math.inf:
                raise ConfigError(f"{self.name}.{key} = {getattr(self, key)} must be positive and finite.")
        if not 0 <= self.poisson < 0.5:
            raise ConfigError(f"{self.name}.poisson = {self.poisson} must be at least 0 and below 0.5.")

    def to_dict(self) -> dict[str, float]:
        return dataclasses.asdict(self)

    @property
    def shear_modulus(self) -> float:
        """μ, in Pa."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def bulk_modulus(self) -> float:
        """λ + μ, the stiffness against a change of area in plane strain, in Pa."""
        return self.shear_modulus / (1 - 2 * self.poisson)

    @property
    def wave_speed(self) -> float:
        return math.sqrt((self.bulk_modulus + self.shear_modulus) / self.density)

    def bulk_stiffness(self, energy: float) -> float:  # noqa: ARG002  # (the law is linear in Hencky's strains)
        return self.bulk_modulus

    def rest(self, dim: int) -> tuple[float, ...]:
        if dim != 2:
            raise ConfigError(f"{self.name} is implemented in two dimensions, not in {dim}.")
        return 1.0, 0.0, 1.0
