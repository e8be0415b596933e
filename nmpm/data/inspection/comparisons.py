"""Compares the trajectories of a dataset with one another, and what all of them show with the metadata."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from nmpm.data.facts.open_ends import Openings
from nmpm.data.format import Metadata
from nmpm.data.inspection.findings import Finding, Severity
from nmpm.data.inspection.irregular_motion import FEW_CROSSINGS
from nmpm.data.inspection.stated import correction
from nmpm.data.statistics import FINE_STEPS, Extent, too_coarse
from nmpm.scene import Interval

_MIXED = 1.1  # factor between time steps
_RESOLUTIONS = 1.3  # factor between spacings
_WALL_LAYER = 0.025  # of the bounds: positions beyond it are not in a wall layer
_TOO_LARGE, _FAR_TOO_LARGE = 3.0, 10.0  # times the extent of all positions
_FEW_BOUNCES = 5
_SOLID = 2.0  # spacings from an end
_STILL_SHARE = 0.01  # of the particles of a type
_SAME_END = 2.0  # spacings between the ends of trajectories that end at the same wall
_SAME_PART = 0.03  # of the extent, at most
_FEW_ENDS = 3
_END_SHARE = 0.4  # of the trajectories that end at a wall
_STAYS = 0.3  # of the frames: particles are at a wall
_BEYOND = 0.1  # of the extent, beyond such a wall
_WALL_NAMES = ("wall", "boundary", "static", "obstacle", "fixed", "frozen")


def compare_time_steps(steps: Mapping[str, float], what: str) -> Iterator[Finding]:
    """Yields a finding if time steps, by trajectory and in any unit, differ; `what` names them."""
    if not steps:
        return
    values = np.array(list(steps.values()))
    usual = float(np.median(values))
    ratios = values / usual
    odd = int(np.argmax(np.abs(np.log(ratios))))
    if 1 / _MIXED < ratios[odd] < _MIXED:
        return
    many = int((np.abs(np.log(ratios)) > np.log(_MIXED)).sum())
    yield Finding(
        "mixed time steps",
        Severity.CONTRADICTION,
        f"the {what} of {many} of {len(values)} trajectories differs from the others', e.g. in {list(steps)[odd]} it"
        f" is {ratios[odd]:.3g} times as long. Make a dataset of each, or leave frames out.",
        factor=float(ratios[odd]),
    )


def compare_spacings(spacings: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """Yields a finding if particles' least and largest spacings both differ between trajectories."""
    if not spacings:
        return
    names, values = list(spacings), np.array(list(spacings.values()))
    fine, coarse = int(np.argmin(values[:, 0])), int(np.argmax(values[:, 0]))
    factor = float((values[coarse] / values[fine]).min())
    if factor > _RESOLUTIONS:
        yield Finding(
            "different resolution",
            Severity.CONTRADICTION,
            f"particles are {values[coarse, 0]:.3g} apart in {names[coarse]} and {values[fine, 0]:.3g} in"
            f" {names[fine]}, {factor:.3g} times less. Make a dataset of each resolution.",
            factor=factor,
        )


def compare_domains(
    extents: Mapping[str, np.ndarray], stays: Mapping[str, np.ndarray], spacing: float
) -> Iterator[Finding]:
    """Yields a finding if particles of a trajectory stay far beyond a place at which those of many others end.

    By trajectory: (D, 2) lowest and highest coordinates, and the share of frames in which a particle is near these.
    """
    if len(extents) < 3:
        return
    names, values = list(extents), np.array(list(extents.values()))
    near = np.array(list(stays.values())) > _STAYS
    sizes = np.median(values[..., 1] - values[..., 0], axis=0)
    for axis, end in np.ndindex(values.shape[1:]):
        outward, staying = values[:, axis, end] * (1 if end else -1), near[:, axis, end]
        wall = float(np.median(outward))
        same = (np.abs(outward - wall) < min(_SAME_END * spacing, _SAME_PART * sizes[axis])) & staying
        beyond = staying & (outward - wall > max(_BEYOND * sizes[axis], 2 * _SAME_END * spacing))
        if same.sum() >= _FEW_ENDS and same.mean() > _END_SHARE and beyond.any():
            odd = int(np.argmax(np.where(beyond, outward, -np.inf)))
            yield Finding(
                "different domains",
                Severity.CONTRADICTION,
                f"in {int(beyond.sum())} of {len(names)} trajectories particles stay at {'xyz'[axis]} ="
                f" {values[odd, axis, end]:.4g}, e.g. in {names[odd]}; in others they end at"
                f" {wall if end else -wall:.4g}. Make a dataset of each domain.",
                factor=float((values[odd, axis, 1] - values[odd, axis, 0]) / sizes[axis]),
            )
            return


def compare_bounds(extent: Extent, walls: Extent, metadata: Metadata) -> Iterator[Finding]:
    """Yields findings if particles move beyond the stated bounds, or these are far larger than where particles are."""
    lower, upper = np.asarray(metadata.bounds).T
    size, walled = upper - lower, np.asarray(metadata.boundary) == "wall"
    seen = np.maximum(extent.upper, walls.upper) - np.minimum(extent.lower, walls.lower)
    beyond = np.maximum(lower - extent.lower, extent.upper - upper) / size * walled
    larger = np.where(walled, size / np.maximum(seen, 1e-12 * size), 0.0)
    axis = int(np.argmax(beyond))
    if beyond[axis] > 0:
        serious = beyond[axis] > _WALL_LAYER
        mend = f" {correction(f'--bounds={_option(extent.intervals)}')}" if serious else " The domain contains them."
        yield Finding(
            "bounds",
            Severity.CONTRADICTION if serious else Severity.NOTE,
            f"along {_axes(beyond > 0)} positions reach beyond the stated ones, by up to {beyond[axis]:.2%} of their"
            f" size: {'xyz'[axis]} is {_span(extent.intervals[axis])}, stated {_span(metadata.bounds[axis])}.{mend}",
            factor=float(seen[axis] / size[axis]),
        )
    axis = int(np.argmax(larger))
    if larger[axis] > _TOO_LARGE:
        yield Finding(
            "far bounds",
            Severity.CONTRADICTION if larger[axis] > _FAR_TOO_LARGE else Severity.ODDITY,
            f"along {_axes(larger > _TOO_LARGE)} they are up to {larger[axis]:.3g} times as large as where particles"
            f" ever are: {'xyz'[axis]} is {_span(extent.intervals[axis])}, stated {_span(metadata.bounds[axis])}.",
            factor=float(larger[axis]),
        )


def check_crossings(metadata: Metadata, crossings: np.ndarray) -> Iterator[Finding]:
    """Yields a finding if particles cross walls: (D,) steps from one end of all positions to the other."""
    crossed = (crossings >= FEW_CROSSINGS) & ~np.asarray(metadata.periodic)
    if crossed.any():
        yield Finding(
            "boundary",
            Severity.CONTRADICTION,
            f"along {_axes(crossed)} it is stated as not periodic, but {int(crossings.sum())} times a particle leaves"
            f" at one end and is at the other. {correction('--boundary ' + _boundary(metadata, crossed, 'periodic'))}",
        )


def check_openings(metadata: Metadata, openings: Sequence[Openings]) -> Iterator[Finding]:
    """Yields a finding if tracks end for good near the ends of an axis whose stated boundary lets nothing out."""
    closed = np.asarray(metadata.boundary) != "open"
    near = [opening for opening in openings if not opening.anywhere]
    ends = np.array([sum(each.ends for each in near if axis in each.axes) for axis in range(metadata.dim)])
    opened = (ends >= FEW_CROSSINGS) & closed
    if opened.any():
        yield Finding(
            "boundary",
            Severity.CONTRADICTION,
            f"along {_axes(opened)} it is stated as {metadata.boundary[int(np.argmax(opened))]}, but {int(ends.max())}"
            " particles are seen last near its ends, and then no more: they leave, or were lost."
            f" {correction('--boundary ' + _boundary(metadata, opened, 'open'))}",
        )


def check_periods(
    metadata: Metadata, wraps: np.ndarray, bounces: np.ndarray, walls: Extent, spacing: float
) -> Iterator[Finding]:
    """Yields a finding if particles never cross the ends of a periodic axis, but turn back from them.

    `wraps` (D,) and `bounces` (D, 2) say how often. Where static particles, `walls`, are at the ends, a model may do
    without the wall.
    """
    lower, upper = np.asarray(metadata.bounds).T
    solid = (walls.lower < lower + _SOLID * spacing) | (walls.upper > upper - _SOLID * spacing)
    closed = (wraps == 0) & (bounces.sum(axis=1) >= _FEW_BOUNCES)
    if closed.any():
        yield Finding(
            "boundary",
            Severity.ODDITY if solid[closed].all() else Severity.CONTRADICTION,
            f"along {_axes(closed)} it is stated as periodic, but nobody ever crosses the ends, and"
            f" {int(bounces.sum())} times a particle turns back there."
            f" {correction('--boundary ' + _boundary(metadata, closed, 'wall'))}",
        )


def _boundary(metadata: Metadata, axes: np.ndarray, kind: str) -> str:
    """The stated kinds of boundaries, but on some (D,) axes another one."""
    return ",".join(kind if axis else old for axis, old in zip(axes, metadata.boundary, strict=True))


def check_precision(spacing: float, rounding: float, extent: Extent) -> Iterator[Finding]:
    """Yields a finding if float32 resolves coordinates too coarsely for the spacing of particles."""
    for sentence in too_coarse(spacing, rounding, extent.lower):
        yield Finding("float32", Severity.CONTRADICTION, sentence, factor=FINE_STEPS * rounding / spacing)


def check_types(metadata: Metadata, still: Mapping[int, int], moving: Mapping[int, int]) -> Iterator[Finding]:
    """Yields findings if particles of a material never move, or those of a wall do; from their numbers by type."""
    names = metadata.particle_types
    shares = {i: count / (count + moving.get(i, 0)) for i, count in still.items()}
    resting = [i for i in sorted(shares) if shares[i] >= _STILL_SHARE and still[i] > 1]
    if resting and any(moving.values()):
        many = ", ".join(
            f"{still[i]} of {still[i] + moving.get(i, 0)} particles of type {i}, {names[i]}," for i in resting
        )
        whole = [i for i in resting if shares[i] == 1.0]
        ids = ",".join(map(str, sorted(metadata.static_types | set(whole))))
        mend = correction(f"--static {ids}") if whole else "Give them a type of their own, which is static."
        yield Finding(
            "still particles",
            Severity.CONTRADICTION,
            f"{many} never move, while other particles do. Are they walls? {mend}",
            factor=max(shares[i] for i in resting),
        )
    walls = [i for i in sorted(moving) if moving[i] and any(word in names[i].lower() for word in _WALL_NAMES)]
    if walls:
        yield Finding(
            "walls that are predicted",
            Severity.CONTRADICTION,
            f"type {', '.join(f'{i}, {names[i]},' for i in walls)} moves and counts as a material. If it is an obstacle"
            f" that moves as recorded: nmpm convert FOLDER NEW --prescribed {','.join(map(str, walls))}.",
        )


def check_lengths(frames: Counter[int], window: int) -> Iterator[Finding]:
    """Yields a finding if trajectories have fewer frames than a training window; a note if all have."""
    short = sum(count for number, count in frames.items() if number < window)
    if short:
        some = short < frames.total()
        yield Finding(
            "short trajectories",
            Severity.ODDITY if some else Severity.NOTE,
            f"{short} of {frames.total()} trajectories have fewer than {window} frames (the shortest {min(frames)}), as"
            f" training windows of the shipped configurations have{': a training leaves them out' if some else ''}.",
            factor=short / frames.total(),
        )


def _axes(mask: np.ndarray) -> str:
    return ", ".join("xyz"[axis] for axis in np.flatnonzero(mask))


def _span(interval: Interval) -> str:
    return f"{interval[0]:.4g}…{interval[1]:.4g}"


def _option(intervals: tuple[Interval, ...]) -> str:
    return ",".join(f"{low:.4g}:{high:.4g}" for low, high in intervals)
