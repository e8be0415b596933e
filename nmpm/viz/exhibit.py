"""What is to be drawn: the same particles in one or more rows, such as the simulation and a prediction of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nmpm.errors import DataError
from nmpm.scene import Interval, Scene

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Exhibit:
    """Trajectories of the same N particles over the same T frames, and the box they are in.

    Args:
        rows: Positions (T, N, D) by label, in domain length; D is 2 or 3. The first row is what the others are
            compared with.
        material: (N,) name of each particle's material (`material_names` makes them from ids).
        bounds: Where particles may be, (lower, upper) per axis.
        dt: Time between frames, in seconds.
        domain: Outer side of the walls, (lower, upper) per axis; the bounds when left out.
        obstacle: (M, D) particles that do not move.
        periodic: Whether each axis wraps; no axis does when left out.
        gravity: (D,) external acceleration; in 3-D its largest component says which axis is drawn upright (the
            second one when left out).
        title: Heading of the picture.

    Raises:
        DataError: if shapes do not fit together or a position is not finite; names row, frame and particle.
    """

    rows: Mapping[str, Floats]
    material: NDArray[np.str_]
    bounds: tuple[Interval, ...]
    dt: float
    domain: tuple[Interval, ...] | None = None
    obstacle: Floats | None = None
    periodic: tuple[bool, ...] = ()
    gravity: tuple[float, ...] | None = None
    title: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "material", np.asarray(self.material, dtype=np.str_))
        self._check_rows()
        self._check_box()

    @classmethod
    def of_scene(
        cls,
        scene: Scene,
        rows: Mapping[str, Floats],
        material: ArrayLike,
        obstacle: Floats | None = None,
        title: str = "",
    ) -> Exhibit:
        """An exhibit that takes box, time step, periodicity, gravity and materials' names from a scene.

        Args:
            scene: The scene.
            rows: As in `Exhibit`.
            material: (N,) index into `Scene.materials`.
            obstacle: As in `Exhibit`.
            title: As in `Exhibit`.
        """
        return cls(
            rows,
            material_names(material, dict(enumerate(scene.materials))),
            bounds=scene.bounds,
            dt=scene.dt,
            domain=scene.domain,
            obstacle=obstacle,
            periodic=scene.periodic,
            gravity=scene.gravity,
            title=title,
        )

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(next(iter(self.rows.values())))

    @property
    def dim(self) -> int:
        """Number of space dimensions D."""
        return int(next(iter(self.rows.values())).shape[2])

    @property
    def materials(self) -> tuple[str, ...]:
        """The materials that occur, in order of first appearance."""
        return tuple(dict.fromkeys(self.material.tolist()))

    @property
    def obstacles(self) -> Floats:
        """Obstacle particles, (M, D); M is 0 where there are none."""
        return np.zeros((0, self.dim)) if self.obstacle is None else self.obstacle

    @property
    def walls(self) -> tuple[Interval, ...]:
        """Outer side of the walls, (lower, upper) per axis."""
        return self.domain or self.bounds

    def spread(self, count: int) -> list[int]:
        """At most `count` frames, evenly spread from the first to the last."""
        picked = np.linspace(0, self.frames - 1, min(count, self.frames))
        return [int(frame) for frame in np.round(picked)]

    def errors(self) -> dict[str, NDArray[np.float64]]:
        """Root mean square distance of each later row's particles from the first row's, (T,) in domain length."""
        reference, *others = self.rows
        return {label: self._distance(self.rows[reference], self.rows[label]) for label in others}

    def wrapped(self, position: Floats) -> Floats:
        """Positions (..., D) brought back into the box along the axes that wrap."""
        if not any(self.periodic):
            return position
        low, high = np.array(self.bounds).T
        return np.where(self.periodic, low + np.mod(position - low, high - low), position)

    def _distance(self, reference: Floats, other: Floats) -> NDArray[np.float64]:
        squares = np.zeros(self.frames)
        for axis, wraps in enumerate(self.periodic or (False,) * self.dim):
            difference = other[..., axis].astype(np.float64) - reference[..., axis]
            if wraps:
                length = self.bounds[axis][1] - self.bounds[axis][0]
                difference -= length * np.round(difference / length)
            squares += np.square(difference).mean(axis=1)
        return np.sqrt(squares)

    def _check_rows(self) -> None:
        if not self.rows:
            raise DataError("There is nothing to draw: an exhibit needs at least one row of positions.")
        shape = next(iter(self.rows.values())).shape
        if len(shape) != 3 or shape[0] < 1 or shape[1] < 1 or shape[2] not in (2, 3):
            raise DataError(
                f"Positions to draw have shape {shape}; expected (frames, particles, 2 or 3), none of them empty."
            )
        for label, position in self.rows.items():
            if position.shape != shape:
                raise DataError(
                    f"Row {label!r} has shape {position.shape}, but row {next(iter(self.rows))!r} has {shape}: "
                    "cut both to the same frames and particles."
                )
            _check_finite(position, label)
        if self.material.shape != shape[1:2]:
            raise DataError(
                f"Materials have shape {self.material.shape}, expected one name for each of {shape[1]} particles."
            )

    def _check_box(self) -> None:
        for name, box in {"bounds": self.bounds, "domain": self.walls}.items():
            if len(box) != self.dim or not all(low < high and np.isfinite(high - low) for low, high in box):
                raise DataError(f"{name} = {box} must give (lower, upper) for each of {self.dim} axes.")
        for name, values in {"periodic": self.periodic, "gravity": self.gravity}.items():
            if values and len(values) != self.dim:
                raise DataError(f"{name} = {values} must have one entry for each of {self.dim} axes.")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise DataError(f"dt = {self.dt} must be a positive number of seconds between frames.")
        if self.obstacles.ndim != 2 or self.obstacles.shape[1] != self.dim:
            raise DataError(f"Obstacles have shape {self.obstacles.shape}, expected (particles, {self.dim}).")
        _check_finite(self.obstacles[None], "obstacle")


def material_names(ids: ArrayLike, names: Mapping[int, str] | Sequence[str]) -> NDArray[np.str_]:
    """The name of each particle's material, (N,).

    Args:
        ids: (N,) integer ids.
        names: Name of each id.

    Raises:
        DataError: if an id has no name.
    """
    known = names if isinstance(names, Mapping) else dict(enumerate(names))
    unique, inverse = np.unique(np.asarray(ids), return_inverse=True)
    missing = [int(number) for number in unique if int(number) not in known]
    if missing:
        listed = ", ".join(f"{number} {name}" for number, name in known.items())
        raise DataError(f"Particle type {missing[0]} has no name; known: {listed}. Name it in `particle_types`.")
    return np.array([known[int(number)] for number in unique], dtype=np.str_)[inverse]


def _check_finite(position: Floats, label: str) -> None:
    finite = np.isfinite(position).all(axis=2)
    if not finite.all():
        frame, particle = (int(index) for index in np.argwhere(~finite)[0])
        raise DataError(
            f"Row {label!r}: particle {particle} is at {position[frame, particle].tolist()} in frame {frame}; "
            f"{int((~finite).sum())} of the row's positions are not finite. Draw fewer frames, or mend the data."
        )
