"""What the simulator asks of a material."""

from __future__ import annotations

import abc
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Material(abc.ABC):
    """A constitutive model: how stress follows from the motion so far.

    The simulator keeps one symmetric tensor per particle for it, the elastic left Cauchy-Green strain, as the three
    components (xx, xy, yy), which is (1, 0, 1) at the start.
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
    def respond(self, strain: Array, gradient: Array, stress: Array, dt: float) -> None:
        """Carry the strain over one substep, in place, and write the stress that it causes.

        Args:
            strain: (N, 3) elastic left Cauchy-Green strain.
            gradient: (N, 2, 2) velocity gradient, d v_i / d x_j, per second.
            stress: (N, 3) Kirchhoff stress (xx, xy, yy), in Pa; overwritten.
            dt: Length of the substep, in seconds.
        """
