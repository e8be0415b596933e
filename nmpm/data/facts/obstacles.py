"""Types of particles that never move, or move as one rigid body; particles that never move among those that do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from nmpm.data.facts.fact import Fact, Unmoving

_STILL = 1e-3  # of the spacing: particles that move less never move
_MOVES = 0.5  # of the spacing: half of the particles move more where a trajectory moves
_RIGID = 1e-2  # of the spacing, by which particles of a rigid body may be off
_FRAMES, _PARTICLES = 12, 200  # in which a rigid motion is fitted
_MOST = 100  # of a list


class TypeMotion:
    """Accumulates how far the particles of each type move."""

    def __init__(self) -> None:
        self.types: dict[int, int] = {}  # trajectories in which each type occurs
        self._range: dict[int, float] = {}  # in mean spacings
        self._unmoving: dict[int, list[Unmoving]] = {}
        self.count = 0

    def add(self, types: np.ndarray, present: np.ndarray, reach: np.ndarray, spacing: float) -> None:
        """Adds a trajectory.

        Args:
            types: (N,) type ids.
            present: (N,) whether a particle is ever there.
            reach: (N,) extent of each particle's path, NaN where it is there in less than two frames.
            spacing: Mean distance of particles.
        """
        paths_of_movers = reach[reach > _STILL * spacing]
        moving = len(paths_of_movers) > 0 and float(np.median(paths_of_movers)) > _MOVES * spacing
        for kind in np.unique(types[present]).tolist():
            of_kind = np.flatnonzero(types == kind)
            paths = reach[of_kind]
            self.types[kind] = self.types.get(kind, 0) + 1
            self._range[kind] = max(self._range.get(kind, 0.0), float(np.fmax.reduce(paths, initial=0.0)) / spacing)
            still = of_kind[paths < _STILL * spacing]
            if moving and len(still) and len(self._unmoving.setdefault(kind, [])) < _MOST:
                self._unmoving[kind].append(Unmoving(self.count, int(still[0]), len(still)))
        self.count += 1

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


def prescribed_fact(positions: Mapping[int, Sequence[np.ndarray]], spacing: float) -> Fact[frozenset[int]]:
    """The types whose particles move as one rigid body, of positions (F, N, D) in each trajectory by type.

    It is none if all types do: a rigid body alone is what is to be predicted.
    """
    rigid = frozenset(
        kind for kind, paths in positions.items() if paths and all(_is_rigid(each, spacing) for each in paths)
    )
    if not rigid or len(rigid) == len(positions):
        return Fact(frozenset(), "no type moves as a rigid body among others that do not.", "measured")
    names = ", ".join(map(str, sorted(rigid)))
    how = f"the particles of type {names} turn and shift as one in every trajectory, those of other types do not."
    return Fact(rigid, how, "likely")


def _is_rigid(position: np.ndarray, spacing: float) -> bool:
    points = position[:, np.isfinite(position).all(axis=(0, 2))][:, :_PARTICLES]
    if points.shape[1] <= points.shape[2] + 1:
        return False  # any motion of few particles is almost rigid
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


def name_types(types: Iterable[int], static: frozenset[int], prescribed: frozenset[int]) -> dict[int, str]:
    """Names of type ids: `boundary`, `moving boundary`, `particles`; with the id where several would have the name."""
    base = {i: "boundary" if i in static else "moving boundary" if i in prescribed else "" for i in sorted(types)}
    counts = {name: list(base.values()).count(name) for name in base.values()}
    return {
        i: (name or "particles") if counts[name] == 1 else f"{name or 'type'}{' ' if name else ''}{i}"
        for i, name in base.items()
    }
