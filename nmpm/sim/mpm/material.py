"""What the material point method needs from a material."""

from __future__ import annotations

import abc
from typing import ClassVar

from nmpm.sim.state import Array


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
