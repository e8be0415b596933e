"""Labelled trajectories of the same particles, such as a simulation and its prediction: the input of all drawing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nmpm.errors import DataError
from nmpm.scene import Interval, Scene

STRAIGHT = math.radians(1)
"""Gravity within this angle of straight down needs no arrow."""
MOST_OBLONG = 1000
"""Longest side of a box over the shortest; pictures grow with it."""
REST_SHARE = 0.02
"""Of the mean motion from frame to frame: added to that of each frame, so that scenes at rest show time that passes."""
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class LabelledTrajectories:
    """Trajectories of the same N particles over the same T frames, with a label each, and the box that contains them.

    Args:
        positions: Positions (T, N, D) by label, in domain length; D is 2 or 3. The first is the reference for errors.
            Particles that are not there in a frame are NaN.
        material: (N,) name of each particle's material, see `material_names`.
        bounds: Region of the particles, (lower, upper) per axis, in domain length.
        dt: Time between frames, in seconds.
        domain: Outer side of the walls, (lower, upper) per axis; default: `bounds`.
        obstacle: (M, D) positions of particles that do not move.
        periodic: Whether each axis is periodic; default: none is.
        gravity: (D,) external acceleration, in any unit. In 3-D the axis of its largest component is drawn vertically
            (default: the second axis); in 2-D an arrow shows it where it is not along the second axis downwards.
        title: Title of the picture.
        fields: Further numbers of the particles by name and label, (T, N), or (1, N) if constant in time; a trajectory
            may lack one. The viewer colours by them.
        prescribed: Names of materials that are not predicted, so that errors leave them out.
        further_members: Where the last of `positions` is a member of an ensemble: the others by label, (T, N, D) each.
            They are drawn behind it, and in bands of the share of members; positions are never averaged.
        densities: Mass density by name of material, for kinetic energies; 1 where left out.

    Raises:
        DataError: if shapes do not match, or a position or a field is not finite; positions may be NaN on all axes.
    """

    positions: Mapping[str, Floats]
    material: NDArray[np.str_]
    bounds: tuple[Interval, ...]
    dt: float
    domain: tuple[Interval, ...] | None = None
    obstacle: Floats | None = None
    periodic: tuple[bool, ...] = ()
    gravity: tuple[float, ...] | None = None
    title: str = ""
    fields: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict)
    prescribed: frozenset[str] = frozenset()
    further_members: Mapping[str, Floats] = field(default_factory=dict)
    densities: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "material", np.asarray(self.material, dtype=np.str_))
        self._check_positions()
        self._check_fields()
        self._check_box()

    @classmethod
    def from_scene(
        cls,
        scene: Scene,
        positions: Mapping[str, Floats],
        material: ArrayLike,
        obstacle: Floats | None = None,
        title: str = "",
        fields: Mapping[str, Mapping[str, Floats]] | None = None,
        gravity: Sequence[float] | None = None,
    ) -> LabelledTrajectories:
        """Takes box, time step, periodicity and material names from a scene, and gravity unless it is given.

        Args:
            scene: The scene.
            positions: As in `LabelledTrajectories`, like the arguments below.
            material: (N,) index into `Scene.materials`.
            obstacle: Static particles.
            title: Of the picture.
            fields: Further numbers of the particles.
            gravity: Where scenes differ in it.
        """
        return cls(
            positions,
            material_names(material, dict(enumerate(scene.materials))),
            bounds=scene.bounds,
            dt=scene.dt,
            domain=scene.domain,
            obstacle=obstacle,
            periodic=scene.periodic,
            gravity=scene.gravity if gravity is None else tuple(gravity),
            title=title,
            fields=fields or {},
            densities=dict(zip(scene.materials, scene.densities, strict=False)),
        )

    @property
    def members(self) -> dict[str, Floats]:
        """The positions of all members of the ensemble by label, the one of `positions` first; none without one."""
        shown = list(self.positions)[-1]
        return {shown: self.positions[shown], **self.further_members} if self.further_members else {}

    @property
    def truth(self) -> Floats | None:
        """What an ensemble, or a prediction, should be: the first of several trajectories."""
        return next(iter(self.positions.values())) if len(self.positions) > 1 else None

    @property
    def frame_count(self) -> int:
        """T."""
        return len(next(iter(self.positions.values())))

    @property
    def dim(self) -> int:
        """D."""
        return int(next(iter(self.positions.values())).shape[2])

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials present, in order of first occurrence."""
        return tuple(dict.fromkeys(self.material.tolist()))

    @property
    def obstacles(self) -> Floats:
        """Positions of the obstacle particles, (M, D); M may be 0."""
        return np.zeros((0, self.dim)) if self.obstacle is None else self.obstacle

    @property
    def outer_bounds(self) -> tuple[Interval, ...]:
        """Outer side of the walls, (lower, upper) per axis."""
        return self.domain or self.bounds

    @property
    def periods(self) -> tuple[float, ...]:
        """The box's length along periodic axes, zero along the others."""
        periodic = self.periodic or (False,) * self.dim
        return tuple((high - low) * wraps for (low, high), wraps in zip(self.bounds, periodic, strict=True))

    @property
    def tilt(self) -> float | None:
        """Counterclockwise angle from straight down to gravity in a 2-D picture, in radians.

        None where gravity points down, is zero or is unknown, and in 3-D, where its axis is drawn vertically.
        """
        if self.dim != 2 or not self.gravity:
            return None
        across, up = self.gravity
        angle = math.atan2(across, -up)
        return angle if abs(angle) > STRAIGHT and (across or up) else None

    def evenly_spaced_frames(self, count: int) -> list[int]:
        """Indices of at most `count` frames, evenly spaced from the first to the last."""
        indices = np.linspace(0, self.frame_count - 1, min(count, self.frame_count))
        return [int(frame) for frame in np.round(indices)]

    def eventful_frames(self, count: int) -> list[int]:
        """Indices of at most `count` frames, from the first to the last, between which particles move equally far."""
        first = next(iter(self.positions.values()))
        moved = self.rms_distance(first[:-1], first[1:])
        moved = moved + REST_SHARE * moved.mean() if moved.any() else np.ones(len(moved))
        path = np.concatenate([[0.0], np.cumsum(moved)])
        nearest = np.abs(path[:, None] - np.linspace(0, path[-1], count)).argmin(axis=0)
        return sorted({*nearest.tolist(), 0, self.frame_count - 1} if count > 1 else {0})

    @property
    def predicted(self) -> NDArray[np.bool_]:
        """Whether each particle is predicted, (N,)."""
        return ~np.isin(self.material, list(self.prescribed))

    def rms_errors(self) -> dict[str, NDArray[np.float64]]:
        """Root mean square position error of each later trajectory against the first, (T,) in length.

        Of the particles that are there in both; 0 where none is.
        """
        reference, *others = self.positions
        return {label: self.rms_distance(self.positions[reference], self.positions[label]) for label in others}

    def rms_distance(self, first: Floats, second: Floats) -> NDArray[np.float64]:
        """Root mean square distance (T,) of the predicted particles of two trajectories (T, N, D), as `rms_errors`."""
        squares = np.zeros(len(first))
        for axis in range(self.dim):
            apart = second[:, self.predicted, axis].astype(np.float64) - first[:, self.predicted, axis]
            difference = self.shortest(apart, axis)
            there = ~np.isnan(difference)
            squares += np.square(np.where(there, difference, 0.0)).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        return np.sqrt(squares)

    @property
    def fullest_frame(self) -> Floats:
        """The positions (N', D) in the first trajectory's frame with the most particles, of those there."""
        first = next(iter(self.positions.values()))
        there = ~np.isnan(first[..., 0])
        frame = int(there.sum(axis=1).argmax())
        return np.asarray(first[frame, there[frame]])

    def wrap(self, position: Floats) -> Floats:
        """Wraps positions (..., D) into the box along the periodic axes."""
        if not any(self.periodic):
            return position
        low, high = np.array(self.bounds).T
        return np.where(self.periodic, low + np.mod(position - low, high - low), position)

    def shortest(self, difference: Floats, axis: int) -> Floats:
        """Differences of positions along an axis, the shortest ones where it is periodic."""
        period = self.periods[axis]
        return difference - period * np.round(difference / period) if period else difference

    def _check_positions(self) -> None:
        if not self.positions:
            raise DataError("There is nothing to draw: `positions` is empty.")
        first, shape = next((label, position.shape) for label, position in self.positions.items())
        if len(shape) != 3 or shape[0] < 1 or shape[1] < 1 or shape[2] not in (2, 3):
            raise DataError(
                f"Positions to draw have shape {shape}; expected (frames, particles, 2 or 3), none of them 0."
            )
        for label, position in {**self.positions, **self.further_members}.items():
            if position.shape != shape:
                raise DataError(
                    f"Trajectory {label!r} has shape {position.shape}, but {first!r} has {shape}: reduce both to the"
                    " same frames and particles."
                )
            absent = np.isnan(position).all(axis=2, keepdims=True)
            _check_finite(f"trajectory {label!r}", np.where(absent, 0.0, position))
        if self.material.shape != shape[1:2]:
            raise DataError(
                f"Materials have shape {self.material.shape}, expected one name for each of {shape[1]} particles."
            )

    def _check_fields(self) -> None:
        shape = next(iter(self.positions.values())).shape[:2]
        for name, by_label in self.fields.items():
            for label, values in by_label.items():
                if label not in self.positions:
                    raise DataError(f"The field {name} is of {label!r}; trajectories are {', '.join(self.positions)}.")
                if values.shape not in (shape, (1, shape[1])):
                    raise DataError(
                        f"The field {name} of {label!r} has shape {values.shape}, expected {shape} (frames, particles)"
                        f" or (1, {shape[1]})."
                    )
                absent = np.isnan(self.positions[label][..., 0]) if values.shape == shape else False
                _check_finite(f"the field {name} of {label!r}", np.where(absent, 0.0, values))

    def _check_box(self) -> None:
        for name, box in {"bounds": self.bounds, "domain": self.outer_bounds}.items():
            if len(box) != self.dim or not all(low < high and np.isfinite(high - low) for low, high in box):
                raise DataError(f"{name} = {box} must be (lower, upper) for each of {self.dim} axes.")
        sides = [high - low for low, high in self.outer_bounds]
        if max(sides) > MOST_OBLONG * min(sides):
            raise DataError(f"A box of {sides} is too oblong to draw: at most {MOST_OBLONG} times as long as wide.")
        for name, values in {"periodic": self.periodic, "gravity": self.gravity}.items():
            if values and len(values) != self.dim:
                raise DataError(f"{name} = {values} must have one entry for each of {self.dim} axes.")
        if not (0 < self.dt * self.frame_count < math.inf):
            raise DataError(f"dt = {self.dt} must be a positive number of seconds between frames.")
        if self.obstacles.ndim != 2 or self.obstacles.shape[1] != self.dim:
            raise DataError(f"Obstacles have shape {self.obstacles.shape}, expected (particles, {self.dim}).")
        _check_finite("the obstacle", self.obstacles[None])


def material_names(ids: ArrayLike, names: Mapping[int, str]) -> NDArray[np.str_]:
    """The material name of each particle, (N,).

    Args:
        ids: (N,) integer ids.
        names: Name of each id.

    Raises:
        DataError: if an id has no name.
    """
    unique, inverse = np.unique(np.asarray(ids), return_inverse=True)
    missing = [index for index in unique.tolist() if index not in names]
    if missing:
        listed = ", ".join(f"{index} {name}" for index, name in names.items())
        raise DataError(f"Particle type {missing[0]} has no name; known: {listed}. Name it in `particle_types`.")
    return np.array([names[index] for index in unique.tolist()], dtype=np.str_)[inverse]


def _check_finite(what: str, values: Floats) -> None:
    """Raise DataError for positions (T, N, D), or numbers (T, N), that are not finite."""
    finite = np.isfinite(values if values.ndim == 3 else values[..., None]).all(axis=2)
    if not finite.all():
        frame, particle = (int(index) for index in np.argwhere(~finite)[0])
        raise DataError(
            f"In {what}, particle {particle} is at {values[frame, particle].tolist()} in frame {frame};"
            f" {int((~finite).sum())} of the values are not finite. Draw fewer frames, or correct the data."
        )
