"""Types of particles that never move, or move as one rigid body; particles that never move among those that do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from nmpm.data.facts.fact import Fact, Unmoving

_STILL = 1e-3  # of the spacing: particles of a type that move less are static
_UNMOVED = 1e-5  # of the spacing: among others of their type, particles that move less never move
_MOVES = 0.5  # of the spacing: half of the particles move more where a trajectory moves
_RIGID = 1e-2  # of the spacing, by which particles of a rigid body may be off
_SAME = 0.1  # of the spacing, by which motions of one program may differ
_START = 6  # frames in which free bodies fall as others do
_FRAMES, _PARTICLES = 12, 200  # in which a rigid motion is fitted
_MOST = 100  # of a list


class TypeMotion:
    """Accumulates how far the particles of each type move."""

    def __init__(self) -> None:
        self._types: dict[int, int] = {}  # trajectories in which each type occurs
        self._range: dict[int, float] = {}  # in mean spacings
        self._unmoving: dict[int, list[Unmoving]] = {}
        self._count = 0

    def add(self, types: np.ndarray, present: np.ndarray, reach: np.ndarray, spacing: float) -> None:
        """Adds a trajectory of N particles at a mean distance.

        By particle: its type, whether it is ever there, and the extent of its path, NaN if it is there only once.
        """
        still = never_moving(reach, spacing)
        for kind in np.unique(types[present]).tolist():
            farthest = float(np.fmax.reduce(reach[types == kind], initial=0.0)) / spacing
            self._types[kind] = self._types.get(kind, 0) + 1
            self._range[kind] = max(self._range.get(kind, 0.0), farthest)
            indices, entries = np.flatnonzero(still & (types == kind)), self._unmoving.setdefault(kind, [])
            if len(indices) and len(entries) < _MOST:
                entries.append(Unmoving(self._count, int(indices[0]), len(indices)))
        self._count += 1

    @property
    def static(self) -> frozenset[int]:
        """Types that never move while others do."""
        still = frozenset(kind for kind, reach in self._range.items() if reach < _STILL)
        return still if len(still) < len(self._range) else frozenset()

    def unmoving(self, materials: frozenset[int]) -> tuple[Unmoving, ...]:
        """Particles of materials that never move, at most a hundred entries per type."""
        return tuple(one for kind in sorted(materials) for one in self._unmoving.get(kind, []))

    def static_fact(self) -> Fact[frozenset[int]]:
        """The types that never move."""
        static = self.static
        if not static:
            return Fact(static, "every type moves.", "measured")
        names = ", ".join(map(str, sorted(static)))
        least = min(self._range[kind] for kind in self._range if kind not in static)
        how = f"the particles of type {names} never move, those of other types move by {least:.3g} spacings or more."
        return Fact(static, how, "measured")

    def names_fact(self, prescribed: frozenset[int]) -> Fact[dict[int, str]]:
        """Names of types: `boundary`, `moving boundary`, `particles`; with the id where several would have the name."""
        kinds = {i: "moving boundary" if i in prescribed else "" for i in sorted(self._types)}
        kinds |= dict.fromkeys(sorted(self.static), "boundary")
        counts = Counter(kinds.values())
        numbered = {i: f"{kind} {i}" if kind else f"type{i}" for i, kind in kinds.items()}
        names = {i: kind or "particles" if counts[kind] == 1 else numbered[i] for i, kind in kinds.items()}
        rare = [f"{kind} in {number}" for kind, number in self._types.items() if number < self._count]
        how = f"by their ids{f'; of {self._count} trajectories type ' if rare else ''}{', '.join(rare)}."
        return Fact(names, how, "guessed")


def path_extents(position: np.ndarray) -> np.ndarray:
    """(N,) extents of the paths of particles (T, N, D) along their longest axis; NaN if one is there only once."""
    low, high = np.fmin.reduce(position, axis=0), np.fmax.reduce(position, axis=0)
    reach = (high - low).max(axis=1).astype(np.float64)
    reach[np.isfinite(position[..., 0]).sum(axis=0) < 2] = np.nan
    return np.asarray(reach)


def never_moving(reach: np.ndarray, spacing: float) -> np.ndarray:
    """Whether particles never move, by the extents of their paths (N,), while most of those that do go far."""
    movers = reach[reach > _STILL * spacing]
    far = len(movers) > 0 and float(np.median(movers)) > _MOVES * spacing
    return np.asarray((reach < _UNMOVED * spacing) & far)


def prescribed_fact(positions: Mapping[int, Sequence[np.ndarray]], spacing: float) -> Fact[frozenset[int]]:
    """The types whose particles move as one rigid body by a program, in positions (F, N, D) of each trajectory by type.

    A program is the same in all trajectories, or goes on at a constant speed; a body that falls as others do is free.
    None is prescribed if all types are rigid: a rigid body alone is what is to be predicted.
    """
    rigid = {kind for kind, paths in positions.items() if paths and all(_is_rigid(each, spacing) for each in paths)}
    if not rigid or len(rigid) == len(positions):
        return Fact(frozenset(), "no type moves as a rigid body among others that do not.", "measured")
    others = [path for kind, paths in positions.items() if kind not in rigid for path in paths]
    prescribed = frozenset(kind for kind in rigid if _has_program(positions[kind], others, spacing))
    free = ", ".join(map(str, sorted(rigid - prescribed)))
    names = ", ".join(map(str, sorted(prescribed)))
    programs = f"the particles of type {names} turn and shift as one, those of others do not"
    bodies = f"type {free} is rigid, and taken for free bodies: it falls, or differs between trajectories"
    how = "; ".join([programs] * bool(names) + [bodies] * bool(free))
    return Fact(prescribed, f"{how}.", "likely")


def _has_program(paths: Sequence[np.ndarray], others: Sequence[np.ndarray], spacing: float) -> bool:
    """Whether bodies (F, N, D) move as others never would: see `prescribed_fact`."""
    centres = [np.nanmean(path, axis=1) for path in paths]
    shifts = [centre - centre[0] for centre in centres]
    length = min(map(len, shifts))
    same = all(np.abs(shift[:length] - shifts[0][:length]).max() < _SAME * spacing for shift in shifts)
    steady = all(np.abs(np.diff(centre, 2, axis=0)).max(initial=0.0) < _RIGID * spacing for centre in centres)
    if len(centres) > 1 and not (same or steady):
        return False
    start = np.mean([np.diff(centre[:_START], 2, axis=0).mean(axis=0) for centre in centres], axis=0)
    falls = np.concatenate([np.diff(other[:_START], 2, axis=0).reshape(-1, len(start)) for other in others])
    falls = falls[np.isfinite(falls).all(axis=1)]
    if not len(falls):
        return True
    fall = np.median(falls, axis=0)
    size = float(np.linalg.norm(fall))
    return size < _STILL / 10 * spacing or float(np.linalg.norm(start - fall)) > _SAME * size


def _is_rigid(position: np.ndarray, spacing: float) -> bool:
    points = position[:, np.isfinite(position).all(axis=(0, 2))][:, :_PARTICLES]
    if points.shape[1] <= points.shape[2] + 1 or len(points) < _START:
        return False  # any motion of few particles in few frames is almost rigid
    rounding = 8 * float(np.finfo(np.float32).eps) * float(np.abs(points).max())
    frames = np.unique(np.linspace(0, len(points) - 1, _FRAMES).astype(int))[1:]
    errors = [_rigid_error(points[0], points[frame]) for frame in frames]
    return bool(errors) and max(errors) < _RIGID * spacing + rounding


def _rigid_error(before: np.ndarray, after: np.ndarray) -> float:
    """Largest distance of (N, D) points from a rotation and shift of others, by Kabsch's algorithm."""
    source, target = before - before.mean(axis=0), after - after.mean(axis=0)
    left, _, right = np.linalg.svd(source.T @ target)
    signs = np.ones(len(right))
    signs[-1] = np.sign(np.linalg.det(left @ right))
    return float(np.abs((source @ (left * signs)) @ right - target).max())
