"""What the simulator asks of a material."""

from __future__ import annotations

import abc
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Material(abc.ABC):
    """A constitutive model: how stress follows from the motion so far.

    The simulator keeps a few numbers per particle for it, its strain; what they mean is the material's own affair.
    Symmetric tensors are written as their upper triangle row by row: (xx, xy, yy), (xx, xy, xz, yy, yz, zz).
    """

    name: ClassVar[str]
    particle_type: ClassVar[int]
    """Type number in the files, after DeepMind's scenes."""

    density: float
    """Mass per area at rest, in kg / m²."""

    @abc.abstractmethod
    def to_dict(self) -> dict[str, float]:
        """The parameters, as a preset's file gives them."""

    @property
    @abc.abstractmethod
    def wave_speed(self) -> float:
        """Speed of the fastest elastic wave at rest, in length per second."""

    @abc.abstractmethod
    def rest(self, dim: int) -> tuple[float, ...]:
        """Strain of a particle in D dimensions that nothing has strained; its length is the number of components."""

    @abc.abstractmethod
    def respond(self, strain: Array, gradient: Array, stress: Array, dt: float) -> None:
        """Carry the strain over one substep, in place, and write the stress that it causes.

        Args:
            strain: (N, S) strain, S at least the length of `rest(D)`; what is beyond belongs to others.
            gradient: (N, D, D) velocity gradient, d v_i / d x_j, per second.
            stress: (N, D (D + 1) / 2) Kirchhoff stress, in Pa; overwritten.
            dt: Length of the substep, in seconds.
        """
