"""Finds motion that no particles make: jumps, frames that repeat or miss, changes of order, measurement noise."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.array_checks import broken_frames, frames_at_one_point, particles_far_away, swapped_axes
from nmpm.data.convert.base import AXES
from nmpm.data.inspection.findings import Finding, Severity
from nmpm.data.inspection.motion import Motion, lengths
from nmpm.data.statistics import relative_positions

FEW_CROSSINGS = 3
"""From one end of all positions to the other: fewer are jumps."""
_JUMP = 5.0  # in spacings
_CONTINUOUS = 4.0  # a jump is so many times larger than the change of velocity across it
_SHARED = 0.5  # of a jump: neighbours that differ by less from it move along
_COMPARED = 32  # jumps that are compared with their neighbours' motion
_SHUFFLED_SHARE = 0.1  # of the particles
_ALWAYS_SHARE = 0.6  # of the particles, which change places all the time
_ONCE = 2.0  # times the motion before and after it
_SHUFFLED_FRAMES = 4  # that are searched
_MATCHED = 8.0  # the particles that change places move by so many times the distance to the next one in the last frame
_STILL = 1e-6  # of the largest motion: less is none
_ROUNDED = 32.0  # times the rounding of coordinates: slower motion may be lost in it
_GOES_ON = 0.1  # of the motion before an interruption, or after it; with less of the other, something comes to rest
_LONGER = 1.7  # times the steps before and after it is a step over a missing frame
_MOVES = 0.2  # of the typical motion: particles that are compared
_ALIKE = 0.2  # of the median; multiples of particles that differ by less are the same
_LEAST_FRAMES = 8
_LOUD = 0.2  # of the typical displacement
_ENOUGH = 0.05  # of it, for velocities of a smoothed track
_WHITE = -0.6  # correlation of accelerations one frame apart: -2/3 for such errors, -1/2 for random walks
_MOST_FRAMES = 15


def find_irregular_motion(motion: Motion) -> Iterator[Finding]:
    """Yields findings about jumps, and about repeated and missing frames, of particles whose order is constant."""
    if len(motion.step) > 1 and motion.spacing:
        yield from find_jumps(motion)
        yield from find_repeated_frames(motion)
        yield from find_missing_frames(motion)


def find_broken_frames(motion: Motion) -> Iterator[Finding]:
    """Yields findings about frames with all particles at one point, and about particles absurdly far away."""
    empty, far = frames_at_one_point(motion.position), particles_far_away(motion.position)
    overflowed = broken_frames(motion.position) & ~empty
    lost = far & ~overflowed[:, None]
    remedy = f"Leave out what is no data: nmpm convert FOLDER NEW --resample {motion.metadata.dt:.6g}."
    if empty.all():
        remedy = "Are these the positions?"
    for kind, what, wrong in (
        ("empty frames", "all particles are at one point, {}", empty[:, None] & motion.present),
        ("overflowed frames", "particles are absurdly far away, e.g. at {}", far & overflowed[:, None]),
        ("lost particles", "it is absurdly far away, at {}", lost),
    ):
        if wrong.any():
            frame, index = map(int, np.argwhere(wrong)[0])
            frames, particles = (int(wrong.any(axis=axis).sum()) for axis in (1, 0))
            many = f"{counted(frames, 'frame')}, {counted(particles, 'particle')}"
            yield Finding(
                kind,
                Severity.CONTRADICTION,
                f"{what.format(motion.position[frame, index].tolist())} ({many} in all). {remedy}",
                motion.where,
                f"frame {frame}{f', particle {motion.index[index]}' if wrong is lost else ''}",
                badness=float(wrong.mean()),
            )


def find_swapped_axes(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if the axes of particles of one type look swapped and nobody states that they are not."""
    alike = not np.ptp(motion.trajectory.particle_type) and AXES not in motion.metadata.extra
    if alike and (reason := swapped_axes(motion.trajectory.position)):
        yield Finding("axes", Severity.CONTRADICTION, reason, motion.where)


def find_disorder(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if between two frames many particles move to places where others were."""
    if len(motion.step) < 2 or not motion.spacing:
        return
    change = motion.change > motion.spacing
    sudden = np.ones(motion.speed.shape, dtype=bool)  # acceleration before and after the step
    sudden[1:] &= change
    sudden[:-1] &= change
    share = sudden.mean(axis=1)
    for frame in np.argsort(-share, kind="stable")[:_SHUFFLED_FRAMES].tolist():
        if share[frame] > _SHUFFLED_SHARE and _is_shuffled(motion, frame, sudden[frame]):
            moved = float(np.median(motion.speed[frame, sudden[frame]])) / motion.spacing
            yield Finding(
                "particle order",
                Severity.CONTRADICTION,
                f"{share[frame]:.0%} of the particles move by {moved:.2g} spacings, to where others were: their order"
                " changes. Sort the particles of each frame by their id.",
                motion.where,
                f"frame {frame + 1}",
                badness=float(share[frame]),
            )
            return


def _is_shuffled(motion: Motion, frame: int, moved: np.ndarray) -> bool:
    """Whether the (N,) particles that move suddenly come to places where, but for the mean motion, others were.

    Those that do so once are much slower before and after; if all do so all the time, most move suddenly.
    """
    drift = np.nanmean(motion.step[frame], axis=0)
    tree, _ = motion.tree(frame)
    later = motion.position[frame + 1, moved] - drift
    nearest = float(np.median(tree.query(relative_positions(later, motion.metadata))[0]))
    around = motion.speed[[max(frame - 1, 0), min(frame + 1, len(motion.speed) - 1)]][:, moved]
    distance = float(np.median(motion.speed[frame, moved]))
    alone = distance > _ONCE * np.nanmedian(around) or moved.mean() > _ALWAYS_SHARE
    return bool(alone and distance > max(motion.spacing, _MATCHED * nearest) and nearest < motion.spacing / 2)


def find_jumps(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if particles are displaced, but neither their velocity nor their neighbours are."""
    sudden = np.flatnonzero((motion.change > _JUMP / 2 * motion.spacing).any(axis=0))
    wraps = motion.crossings[motion.crossings.sum(axis=(1, 2)) >= FEW_CROSSINGS].any(axis=0)
    jumps = np.zeros(motion.speed.shape)
    jumps[:, sudden] = _interrupted_paths(motion.step[:, sudden])
    frames, indices = np.nonzero((jumps > _JUMP * motion.spacing) & ~wraps)
    order = np.argsort(-jumps[frames, indices], kind="stable")
    for place in order[:_COMPARED].tolist():
        frame, index = int(frames[place]), int(indices[place])
        if not _neighbours_move_along(motion, frame, index):
            many = len(set(indices.tolist()))
            others = f", and so do {many - 1} other particles" if many > 1 else ""
            size = motion.speed[frame, index]
            yield Finding(
                "jumps",
                Severity.ODDITY,
                f"it moves by {size:.3g} in one frame, {size / motion.spacing:.0f} spacings, while its neighbours do"
                f" not{others}. Cut the trajectory there, or leave it out.",
                motion.where,
                f"frame {frame + 1}, particle {motion.index[index]}",
                badness=float(size / motion.spacing),
            )
            return


def _interrupted_paths(step: np.ndarray) -> np.ndarray:
    """(T - 1, N): by how much one of the steps (T - 1, N, D) leaves the path that goes on after it, or 0.

    It leaves it for good, so that the velocities before and after the step are the same, or for one frame, so that the
    velocity after the next step is.
    """
    jumps = np.zeros(step.shape[:2])
    if len(step) > 2:
        away = lengths(step[1:-1] - (step[:-2] + step[2:]) / 2)
        jumps[1:-1] = np.where(away > _CONTINUOUS * lengths(step[2:] - step[:-2]), away, 0.0)
    if len(step) > 3:
        middle = (step[1:-2] + step[2:-1]) / 2
        away = lengths(step[1:-2] - middle)
        changes = np.maximum(lengths(middle - (step[:-3] + step[3:]) / 2), lengths(step[3:] - step[:-3]))
        jumps[1:-2] = np.maximum(jumps[1:-2], np.where(away > _CONTINUOUS * changes, away, 0.0))
    return jumps


def _neighbours_move_along(motion: Motion, frame: int, index: int) -> bool:
    """Whether most of the nearest particles make about the same step."""
    tree, indices = motion.tree(frame)
    if len(indices) < 2:
        return False
    near = tree.query(tree.data[np.searchsorted(indices, index)], k=range(2, min(8, len(indices)) + 1))[1]
    difference = lengths(motion.step[frame, indices[near]] - motion.step[frame, index])
    return bool(np.nanmedian(difference) < _SHARED * motion.speed[frame, index])


def find_repeated_frames(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if nothing moves between two frames, though it does until then and goes on after it."""
    repeated = _interruptions(motion.typical, _ROUNDED * motion.rounding)
    if len(repeated):
        yield Finding(
            "repeated frames",
            Severity.CONTRADICTION,
            f"it repeats the frame before, while particles move ({len(repeated)} of {len(motion.position)} frames do)."
            " Remove them.",
            motion.where,
            f"frame {repeated[0] + 1}",
            badness=len(repeated) / len(motion.typical),
        )


def _interruptions(typical: np.ndarray, least: float) -> np.ndarray:
    """Indices of steps (T - 1,) without motion, between steps with motion of about the same size, at least `least`."""
    moves = np.flatnonzero(~(typical <= _STILL * np.nanmax(typical, initial=0.0)))  # or nobody knows
    last, following = moves[:-1], moves[1:]
    low, high = np.fmin(typical[last], typical[following]), np.fmax(typical[last], typical[following])
    interrupted = np.flatnonzero((following > last + 1) & (low > np.maximum(least, _GOES_ON * high)))
    return np.concatenate([np.arange(last[i] + 1, following[i]) for i in interrupted] or [np.empty(0, dtype=int)])


def find_missing_frames(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if between two frames all particles move by a multiple of their motion before and after."""
    typical = motion.typical
    least = _LONGER * np.maximum(typical[:-2], typical[2:])
    missing = [frame for frame in (np.flatnonzero(typical[1:-1] > least) + 1).tolist() if _is_multiple(motion, frame)]
    if missing:
        factor = float(np.median(_multiples(motion, missing[0])))
        yield Finding(
            "missing frames",
            Severity.CONTRADICTION,
            f"since the frame before, all particles move {factor:.1f} times as far as before and after it: frames are"
            f" missing{f', so in {len(missing)} places' if len(missing) > 1 else ''}. Cut the trajectory there.",
            motion.where,
            f"frame {missing[0] + 1}",
            factor,
            badness=len(missing),
        )


def _multiples(motion: Motion, frame: int) -> np.ndarray:
    """(N',) the step of each particle that moves, as a multiple of the mean of the steps before and after it."""
    mean = (motion.step[frame - 1] + motion.step[frame + 1]) / 2
    square = (mean**2).sum(axis=-1)
    moves = square > (_MOVES * motion.typical[frame - 1]) ** 2
    return np.asarray((motion.step[frame] * mean).sum(axis=-1)[moves] / square[moves])


def _is_multiple(motion: Motion, frame: int) -> bool:
    multiples = _multiples(motion, frame)
    low, middle, high = np.quantile(multiples, (0.25, 0.5, 0.75)) if len(multiples) else (0.0, 0.0, 0.0)
    return bool(middle > _LONGER and high - low < _ALIKE * middle)


def find_noise(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if positions are noisy: accelerations alternate as those of errors that are new in each frame.

    The second difference of independent errors of standard deviation σ has the variance 6 σ², and that of successive
    ones correlate by -2/3.
    """
    noise, typical = white_noise(motion.step)
    if noise < _LOUD * typical or not noise:
        return
    frames = smoothing_frames(noise / typical)
    yield Finding(
        "measurement noise",
        Severity.ODDITY,
        f"positions have errors of about {noise:.2g}, {noise / typical:.2g} of the typical displacement in a frame."
        f" Smooth them: nmpm convert FOLDER NEW --smooth {frames}.",
        motion.where,
        factor=noise / typical,
        badness=noise / typical,
    )


def white_noise(step: np.ndarray) -> tuple[float, float]:
    """The standard deviation of errors of positions, 0 where there are none, and the typical displacement in a frame.

    Of displacements (T, N, D), NaN where a particle is absent.
    """
    typical = math.sqrt(float(np.nanmean(step**2)))
    if len(step) < _LEAST_FRAMES:
        return 0.0, typical
    acceleration = np.diff(step, axis=0)
    square = float(np.nanmean(acceleration**2))
    product = float(np.nanmean(acceleration[1:] * acceleration[:-1]))
    return (math.sqrt(square / 6) if square and product / square <= _WHITE else 0.0), typical


def smoothing_frames(noise: float) -> int:
    """Frames of local fits that take noise, in typical displacements, out of velocities."""
    return next((n for n in range(5, _MOST_FRAMES, 2) if _slope_error(n) * noise < _ENOUGH), _MOST_FRAMES)


def _slope_error(frames: int) -> float:
    """The standard deviation of a slope that is fitted to so many frames, in errors of a position per frame."""
    return math.sqrt(12 / (frames**3 - frames))
