"""Findings about a dataset: contradictions, oddities and notes, one line per kind, worst first."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.array_checks import broken_frames, frames_at_one_point, particles_far_away, swapped_axes
from nmpm.data.boundaries import FEW_CROSSINGS
from nmpm.data.metadata import FOUND
from nmpm.data.samples import take_sample
from nmpm.data.spacing import relative_positions
from nmpm.data.stated import AXES
from nmpm.data.statistics import first_moving_particle, first_outside, lengths
from nmpm.data.survey import LEAST_PARTICLES, RecordedMotion, smoothing_frames
from nmpm.data.times import find_time_fault, recorded_times, step_by_velocities
from nmpm.data.volumes import VOLUME


class Severity(StrEnum):
    """How bad a finding is, worst first."""

    CONTRADICTION = "contradiction"  # a model that trusts the data becomes wrong
    ODDITY = "oddity"  # it may
    NOTE = "note"  # it does not


@dataclass(frozen=True)
class Finding:
    """Something to know about a dataset, or about one of its trajectories."""

    kind: str  # what it is about, e.g. "gravity" or "jumps"; findings of a kind are shown in one line
    severity: Severity
    sentence: str  # what is wrong and how to mend it
    where: str = ""  # the trajectory, e.g. "train 00003"; empty if it is about the dataset
    details: str = ""  # where in the trajectory, e.g. "frame 12, particle 5"
    factor: float | None = None  # by how much a stated value is too large, or a measured one
    badness: float = 0.0  # orders findings of a kind

    def __str__(self) -> str:
        return ": ".join(filter(None, (self.kind, ", ".join(filter(None, (self.where, self.details))), self.sentence)))


def sort_findings(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The same findings, contradictions first and notes last."""
    return tuple(sorted(findings, key=lambda finding: list(Severity).index(finding.severity)))


def merge_findings(findings: Iterable[Finding], trajectories: int) -> tuple[Finding, ...]:
    """One finding of each kind, of the worst trajectory, that says in how many of `trajectories` it is; worst first."""
    kinds: dict[tuple[str, Severity], list[Finding]] = {}
    for finding in findings:
        kinds.setdefault((finding.kind, finding.severity), []).append(finding)
    return sort_findings(_merge(group, trajectories) for group in kinds.values())


def _merge(group: list[Finding], trajectories: int) -> Finding:
    worst = max(group, key=lambda finding: finding.badness)
    if not worst.where:
        more = f" … and {len(group) - 1} more." if len(group) > 1 else ""
        return replace(worst, sentence=worst.sentence + more)
    count = len({finding.where for finding in group})
    many = f"in {count} of {trajectories} trajectories, worst in " if trajectories > 1 else ""
    return replace(worst, where=many + worst.where)


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


def find_broken_frames(motion: RecordedMotion) -> Iterator[Finding]:
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
                details=f"frame {frame}{f', particle {motion.index[index]}' if wrong is lost else ''}",
                badness=float(wrong.mean()),
            )


def find_swapped_axes(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if the axes of particles of one type look swapped and nobody states that they are not."""
    alike = not np.ptp(motion.trajectory.particle_type) and AXES not in motion.metadata.extra
    if alike and (reason := swapped_axes(motion.trajectory.position)):
        yield Finding("axes", Severity.CONTRADICTION, reason)


def find_disorder(motion: RecordedMotion) -> Iterator[Finding]:
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
                details=f"frame {frame + 1}",
                badness=float(share[frame]),
            )
            return


def _is_shuffled(motion: RecordedMotion, frame: int, moved: np.ndarray) -> bool:
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


def find_jumps(motion: RecordedMotion) -> Iterator[Finding]:
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
                details=f"frame {frame + 1}, particle {motion.index[index]}",
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


def _neighbours_move_along(motion: RecordedMotion, frame: int, index: int) -> bool:
    """Whether most of the nearest particles make about the same step."""
    tree, indices = motion.tree(frame)
    if len(indices) < 2:
        return False
    near = tree.query(tree.data[np.searchsorted(indices, index)], k=range(2, min(8, len(indices)) + 1))[1]
    difference = lengths(motion.step[frame, indices[near]] - motion.step[frame, index])
    return bool(np.nanmedian(difference) < _SHARED * motion.speed[frame, index])


def find_repeated_frames(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if nothing moves between two frames, though it does until then and goes on after it."""
    typical, least = motion.typical, _ROUNDED * motion.rounding
    moves = np.flatnonzero(~(typical <= _STILL * np.nanmax(typical, initial=0.0)))  # or nobody knows
    last, following = moves[:-1], moves[1:]
    low, high = np.fmin(typical[last], typical[following]), np.fmax(typical[last], typical[following])
    interrupted = np.flatnonzero((following > last + 1) & (low > np.maximum(least, _GOES_ON * high)))
    if len(interrupted):
        repeated = int((following - last - 1)[interrupted].sum())
        yield Finding(
            "repeated frames",
            Severity.CONTRADICTION,
            f"it repeats the frame before, while particles move ({repeated} of {len(motion.position)} frames do)."
            " Remove them.",
            details=f"frame {last[interrupted[0]] + 2}",
            badness=repeated / len(typical),
        )


def find_missing_frames(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if between two frames all particles move by a multiple of their motion before and after."""
    typical, factors = motion.typical, dict[int, float]()
    for frame in (np.flatnonzero(typical[1:-1] > _LONGER * np.maximum(typical[:-2], typical[2:])) + 1).tolist():
        mean = (motion.step[frame - 1] + motion.step[frame + 1]) / 2
        square = (mean**2).sum(axis=-1)
        moves = square > (_MOVES * typical[frame - 1]) ** 2
        multiples = (motion.step[frame] * mean).sum(axis=-1)[moves] / square[moves]
        low, middle, high = np.quantile(multiples, (0.25, 0.5, 0.75)) if moves.any() else (0.0, 0.0, 0.0)
        if middle > _LONGER and high - low < _ALIKE * middle:
            factors[frame] = float(middle)
    if factors:
        frame, factor = next(iter(factors.items()))
        yield Finding(
            "missing frames",
            Severity.CONTRADICTION,
            f"since the frame before, all particles move {factor:.1f} times as far as before and after it: frames are"
            f" missing{f', so in {len(factors)} places' if len(factors) > 1 else ''}. Cut the trajectory there.",
            details=f"frame {frame + 1}",
            factor=factor,
            badness=len(factors),
        )


def find_noise(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if positions are noisy."""
    noise, share = motion.noise
    if noise:
        yield Finding(
            "measurement noise",
            Severity.ODDITY,
            f"positions have errors of about {noise:.2g}, {share:.2g} of the typical displacement in a frame."
            f" Smooth them: nmpm convert FOLDER NEW --smooth {smoothing_frames(share)}.",
            factor=share,
            badness=share,
        )


_DIFFERENT = 1.2  # factor of a gravity
_UNEVEN = 0.01  # of a step of time
_VOLUME = (2.5, 4.0)  # factors by which a stated particle volume may be too large and too small
_EARTH = 9.81
_PARALLEL = 0.9  # cosine of the angle between a stated and a measured gravity
_SAME_NUMBER = 0.03
_PART = 0.02  # of the largest component; smaller ones are rounded to zero
_ROUND_FACTORS = (1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 8.0, 10.0, 20.0, 25.0, 50.0, 100.0, 1000.0)


def find_time_faults(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding about recorded times of frames that are not even."""
    time = recorded_times(motion.trajectory)
    fault = None if time is None else find_time_fault(time)
    if fault is None:
        return
    mend = fault.remedy
    if mend.startswith("--"):
        mend = f"Interpolate: nmpm convert FOLDER NEW {mend}."
    if fault.jitter:
        mend += " Or take them as even by --dt in place of --resample."
    yield Finding(
        "uneven time steps",
        Severity.ODDITY if fault.jitter else Severity.CONTRADICTION,
        f"{fault.sentence} {mend}",
        details=f"frame {fault.frame}",
        factor=fault.factor,
        badness=abs(fault.factor - 1),
    )


def contradiction(fact: str, stated: str, factor: float, reason: str, mend: str, difference: str = "") -> Finding:
    """The finding that a fact is stated as another value than trajectories show; by default, a multiple of it."""
    return Finding(
        fact,
        Severity.CONTRADICTION,
        f"{fact.replace(' ', '_')} is stated as {stated}, {difference or too(factor)}: {reason}. {mend}",
        factor=factor or None,
        badness=abs(math.log(factor)) if factor else math.inf,
    )


def check_dt(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if dt is not the step of recorded times, or if recorded velocities suit another one.

    Recorded times say what dt is. Without any, particles that fall by the stated gravity confirm it, and velocities
    that disagree are in another unit.
    """
    stated, dt = motion.metadata.dt, motion.recorded_step
    by_velocity = step_by_velocities([take_sample(motion.trajectory)] if "velocity" in motion.trajectory.fields else [])
    if dt is not None and abs(stated / dt - 1) > _UNEVEN and not _same(by_velocity, stated):
        reason = f"the recorded times of frames are {dt:.4g} apart"
        yield contradiction("dt", f"{stated:.4g}", stated / dt, reason, correction(f"--dt {dt:.6g}"))
    elif by_velocity is not None and not (_same(by_velocity, stated) or _same(by_velocity, 1.0)):
        falls = dt is None and _falls_by_gravity(motion)
        if dt is None and not falls and "dt" not in motion.metadata.extra.get(FOUND, {}):
            reason, mend = f"recorded velocities are displacements over {by_velocity:.4g}", f"--dt {by_velocity:.6g}"
            yield contradiction("dt", f"{stated:.4g}", stated / by_velocity, reason, correction(mend))
            return
        by = "recorded times" if dt is not None else "the stated gravity" if falls else "dt"
        yield Finding(
            "unit of velocities",
            Severity.NOTE,
            f"recorded velocities are displacements over {by_velocity:.4g}, frames are {stated:.4g} apart by {by};"
            " models use positions alone. For the velocities' unit of time: nmpm convert FOLDER NEW --dt"
            f" {by_velocity:.6g}.",
            factor=stated / by_velocity,
        )


def _same(one: float | None, other: float) -> bool:
    return one is not None and abs(one / other - 1) < _SAME_NUMBER


def _falls_by_gravity(motion: RecordedMotion) -> bool:
    """Whether particles fall freely by the stated gravity, which then confirms dt."""
    stated, fall = motion.stated_gravity, motion.fall
    if stated is None or "gravity" in motion.metadata.extra.get(FOUND, {}) or fall is None or not any(fall):
        return False
    measured = np.asarray(fall) / motion.metadata.dt**2
    return bool(np.linalg.norm(np.asarray(stated) - measured) < (_DIFFERENT - 1) * np.linalg.norm(measured))


def check_gravity(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if particles do not fall freely by the stated gravity; then it is wrong, or dt is."""
    stated, fall, recorded = motion.stated_gravity, motion.fall, motion.recorded_step
    if stated is None or fall is None:
        return
    if not any(fall):
        if any(stated):
            straight = f"gravity is stated as {_vector(stated)}, but in the first frames particles fly straight."
            zero = correction(f"--gravity={_comma(np.zeros(len(fall)))}")
            yield Finding("gravity", Severity.ODDITY, f"{straight} {zero}")
        return
    dt = recorded or motion.metadata.dt
    measured = np.asarray(fall) / dt**2
    factor = float(np.linalg.norm(stated) / np.linalg.norm(measured))
    turned = _compare_directions(stated, measured)
    resized = "" if not factor or 1 / _DIFFERENT < factor < _DIFFERENT else too(factor)
    falls = f"in free fall particles accelerate by {_vector(measured)}"
    if resized and not turned and recorded is None and _suggests_dt(stated, measured, math.sqrt(factor)):
        number = math.sqrt(factor)
        mend = f"{correction(f'--dt {dt / number:.4g}')} Else gravity is {too(factor)}."
        yield contradiction("dt", f"{dt:.4g}", number, falls, mend, f"{too(number)} if gravity is {_vector(stated)}")
    elif turned or resized:
        values = np.where(np.abs(measured) > _PART * np.abs(measured).max(), measured, 0.0)
        difference = " and ".join(filter(None, (turned, resized)))
        mend = correction(f"--gravity={_comma(values)}")
        yield contradiction("gravity", _vector(stated), factor, falls, mend, difference)


def _compare_directions(stated: Sequence[float], measured: np.ndarray) -> str:
    """What is wrong with the direction or presence of a stated gravity; empty if nothing is."""
    size = float(np.linalg.norm(stated))
    if not size:
        return "but there is one"
    cosine = float(np.dot(stated, measured)) / (size * float(np.linalg.norm(measured)))
    if cosine > _PARALLEL:
        return ""
    if cosine < -_PARALLEL:
        return "the opposite direction"
    axes = ["xyz"[int(np.argmax(np.abs(vector)))] for vector in (stated, measured)]
    return f"along {axes[0]} in place of {axes[1]}" if axes[0] != axes[1] else "another direction"


def _suggests_dt(stated: Sequence[float], measured: np.ndarray, ratio: float) -> bool:
    """Whether a wrong dt is more likely than a wrong gravity: its factor is round, and the gravity is the Earth's."""
    simple = any(abs(max(ratio, 1 / ratio) / number - 1) < _SAME_NUMBER for number in _ROUND_FACTORS)
    return simple and (_is_earth(stated) or not _is_earth(measured))


def _is_earth(gravity: Sequence[float] | np.ndarray) -> bool:
    """Whether a gravity is the Earth's, in units that are powers of ten."""
    power = math.log10(float(np.linalg.norm(gravity)) / _EARTH)
    return abs(power - round(power)) < math.log10(1 + _SAME_NUMBER)


def check_volume(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if the stated particle volume is far from that in frames in which particles are dense."""
    stated, dim = motion.trajectory.attributes.get(VOLUME, motion.metadata.particle_volume), motion.metadata.dim
    measured = VOLUME in motion.metadata.extra.get(FOUND, {})  # in these trajectories
    if stated is None or measured or len(motion.index) < LEAST_PARTICLES:
        return
    spacing = float(np.median(motion.spacings[1] or [0.0]))
    factor = stated / spacing**dim if spacing else 1.0
    too_large, too_small = _VOLUME
    if 1 / too_small < factor < too_large:
        return
    reason = f"particles are {spacing:.3g} apart, which makes {spacing**dim:.3g}"
    mend = "Correct it in metadata.json, or remove it, so that it is measured."
    yield contradiction("particle volume", f"{stated:.3g}", factor, reason, mend)


def find_particles_outside(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if particles leave the stated domain."""
    position, metadata = motion.trajectory.position, motion.metadata
    if metadata.domain is None or not (outside := first_outside(position, metadata.domain, metadata.boundary)):
        return
    frame, particle, leaving = outside
    yield Finding(
        "domain",
        Severity.CONTRADICTION,
        f"it is outside of the stated domain, at {position[frame, particle].round(5).tolist()};"
        f" {counted(leaving, 'particle')} in all. Widen the domain in metadata.json, or remove it.",
        details=f"frame {frame}, particle {particle}",
        badness=leaving,
    )


def find_moving_walls(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if particles of a static type move."""
    types, metadata = motion.trajectory.particle_type, motion.metadata
    mover = first_moving_particle(motion.trajectory.position, metadata.is_static(types), metadata.bounds)
    if mover is not None:
        name = metadata.particle_types[int(types[mover])]
        yield Finding(
            "moving walls",
            Severity.CONTRADICTION,
            f"it moves, though its type {types[mover]}, {name}, is static. {prescription([int(types[mover])])}",
            details=f"particle {mover}",
        )


def find_overlaps(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a finding if particles are at the same place in the first frame that has most of them."""
    frame = motion.fullest
    there = motion.position[frame][motion.present[frame]]
    _, first, number = np.unique(there, axis=0, return_index=True, return_counts=True)
    if (number > 1).any():
        indices = motion.index[motion.present[frame]]
        twins = int((number - 1).sum())
        yield Finding(
            "overlapping particles",
            Severity.ODDITY,
            f"it is where another one is; so are {twins} of {len(there)} particles: are some recorded twice?",
            details=f"frame {frame}, particle {indices[first[int(np.argmax(number))]]}",
            badness=twins,
        )


def find_absences(motion: RecordedMotion) -> Iterator[Finding]:
    """Yields a note if particles enter, leave, or are missing in between."""
    there = motion.present
    if there.all():
        return
    enter, leave = int((~there[0]).sum()), int((~there[-1]).sum())
    empty = int((~there.any(axis=1)).sum())
    nobody = f", and {counted(empty, 'frame')} without any particle" if empty else ""
    yield Finding(
        "absent particles",
        Severity.NOTE,
        f"{enter} of {there.shape[1]} particles come after the first frame and {leave} are gone in the last one, in the"
        f" mean {there.sum(axis=1).mean():.4g} are there{nobody}.",
        badness=enter + leave + there.shape[1] * empty,
    )


def too(factor: float) -> str:
    """In words by how much a value is too large, or too small for a factor below 1."""
    return f"{factor:.4g} times too large" if factor > 1 else f"{1 / factor:.4g} times too small"


def correction(option: str) -> str:
    """The sentence that says how an option corrects the metadata."""
    return f"Correct it: nmpm convert FOLDER NEW {option}."


def prescription(types: Iterable[int]) -> str:
    """The sentence that says how particles of some types become obstacles that move as recorded."""
    ids = ",".join(map(str, types))
    return f"If it is an obstacle that moves as recorded: nmpm convert FOLDER NEW --prescribed {ids}."


def _vector(values: Sequence[float] | np.ndarray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


def _comma(values: np.ndarray) -> str:
    return ",".join(f"{value:.4g}" for value in values)
