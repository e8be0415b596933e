"""Finds motion that no particles make: jumps, frames that repeat or miss, particles that change their order."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nmpm.data.inspection.findings import Finding, Severity
from nmpm.data.inspection.motion import Motion

_JUMP = 5.0  # in spacings
_CONTINUOUS = 4.0  # a jump is so many times larger than the change of velocity across it
_SHARED = 0.5  # of a jump: neighbours that differ by less from it move along
_COMPARED = 32  # jumps that are compared with their neighbours' motion
_SHUFFLED_SHARE = 0.1  # of the particles
_SHUFFLED_FRAMES = 4  # that are searched
_MATCHED = 8.0  # the particles that change places move by so many times the distance to the next one in the last frame
_STILL = 1e-6  # of the largest motion: less is none
_ROUNDED = 32.0  # times the rounding of coordinates: slower motion may be lost in it
_GOES_ON = 0.1  # of the motion before an interruption, or after it; with less of the other, something comes to rest
_LONGER = 1.7  # times the steps before and after it is a step over a missing frame
_MOVES = 0.2  # of the typical motion: particles that are compared
_ALIKE = 0.2  # of the median; multiples of particles that differ by less are the same


def find_irregular_motion(motion: Motion) -> Iterator[Finding]:
    """Yields findings about the order of particles or, where it is constant, about jumps and frames."""
    if len(motion.step) < 2 or not motion.spacing:
        return
    disorder = list(find_disorder(motion))
    yield from disorder
    if not disorder:
        yield from find_jumps(motion)
        yield from find_repeated_frames(motion)
        yield from find_missing_frames(motion)


def find_disorder(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if between two frames many particles move to places where others were."""
    change = np.linalg.norm(np.diff(motion.step, axis=0), axis=-1) > motion.spacing
    sudden = np.ones(motion.speed.shape, dtype=bool)  # acceleration before and after the step
    sudden[1:] &= change
    sudden[:-1] &= change
    share = sudden.mean(axis=1)
    for frame in np.argsort(-share, kind="stable")[:_SHUFFLED_FRAMES].tolist():
        if share[frame] < _SHUFFLED_SHARE or sudden[frame].sum() < 2:
            return
        tree, _ = motion.tree(frame)
        later, indices = motion.tree(frame + 1)
        moved = sudden[frame, indices]
        nearest = float(np.median(tree.query(later.data[moved])[0]))
        typical = float(np.median(motion.speed[frame, indices[moved]]))
        if typical > max(motion.spacing, _MATCHED * nearest) and nearest < 0.5 * motion.spacing:
            yield Finding(
                "particle order",
                Severity.CONTRADICTION,
                f"{share[frame]:.0%} of the particles move by {typical / motion.spacing:.2g} spacings, to where others"
                " were: their order changes. Sort the particles of each frame by their id.",
                motion.where,
                f"frame {frame + 1}",
                badness=float(share[frame]),
            )
            return


def find_jumps(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if particles are displaced, but neither their velocity nor their neighbours are."""
    jumps = _interrupted_paths(motion)
    wraps = motion.crossings.any(axis=-1)
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


def _interrupted_paths(motion: Motion) -> np.ndarray:
    """(T - 1, N): by how much a step leaves the path that goes on after it; 0 where the path changes there anyway.

    It leaves it for good, so that the velocities before and after the step are the same, or for one frame, so that the
    two velocities after the next step are.
    """
    step, jumps = motion.step, np.zeros(motion.speed.shape)
    if len(step) > 2:
        away = np.linalg.norm(step[1:-1] - (step[:-2] + step[2:]) / 2, axis=-1)
        jumps[1:-1] = np.where(away > _CONTINUOUS * np.linalg.norm(step[2:] - step[:-2], axis=-1), away, 0.0)
    if len(step) > 3:
        middle = (step[1:-2] + step[2:-1]) / 2
        away = np.linalg.norm(step[1:-2] - middle, axis=-1)
        rest = np.linalg.norm(middle - (step[:-3] + step[3:]) / 2, axis=-1)
        rest = np.maximum(rest, np.linalg.norm(step[3:] - step[:-3], axis=-1))
        jumps[1:-2] = np.maximum(jumps[1:-2], np.where(away > _CONTINUOUS * rest, away, 0.0))
    return jumps


def _neighbours_move_along(motion: Motion, frame: int, index: int) -> bool:
    """Whether most of the nearest particles make about the same step."""
    tree, indices = motion.tree(frame)
    if len(indices) < 2:
        return False
    near = tree.query(tree.data[np.searchsorted(indices, index)], k=range(2, min(8, len(indices)) + 1))[1]
    difference = np.linalg.norm(motion.step[frame, indices[near]] - motion.step[frame, index], axis=-1)
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
    moves = np.flatnonzero(typical > _STILL * typical.max(initial=0.0))
    last, following = moves[:-1], moves[1:]
    low, high = np.minimum(typical[last], typical[following]), np.maximum(typical[last], typical[following])
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
