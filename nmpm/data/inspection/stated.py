"""Compares what a dataset's metadata state with what is measured in one trajectory; particles that are odd."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.facts import FOUND
from nmpm.data.facts.free_fall import Track, find_gravity
from nmpm.data.facts.sample import take_sample
from nmpm.data.facts.timing import step_by_velocities
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.inspection.findings import Finding, Severity
from nmpm.data.inspection.motion import Motion, spacing_of
from nmpm.data.statistics import first_moving_particle, first_outside
from nmpm.data.times import find_time_fault, recorded_step, recorded_times
from nmpm.data.volumes import VOLUME

_FIRST_STEPS = 32  # in which particles are looked for that fly freely
_LEAST_PARTICLES = 8
_DIFFERENT = 1.2  # factor of a gravity
_UNEVEN = 0.01  # of a step of time
_VOLUME = (2.5, 4.0)  # factors by which a stated particle volume may be too large and too small
_VOLUME_FRAMES = 4
_EARTH = 9.81
_PARALLEL = 0.9  # cosine of the angle between a stated and a measured gravity
_SAME_NUMBER = 0.03
_PART = 0.02  # of the largest component; smaller ones are rounded to zero
_ROUND_FACTORS = (1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 8.0, 10.0, 20.0, 25.0, 50.0, 100.0, 1000.0)


def free_fall(motion: Motion) -> tuple[float, ...] | None:
    """The acceleration (D,) of particles in free flight in the first frames, in length per frame²; None if none are.

    It is zero if they fly straight.
    """
    if len(motion.index) < _LEAST_PARTICLES or len(motion.step) < 2 or not motion.spacing:
        return None
    path = motion.position[0] + np.cumsum(np.insert(motion.step[:_FIRST_STEPS], 0, 0.0, axis=0), axis=0)
    gravity = find_gravity([Track(path, np.arange(len(path), dtype=np.float64))], motion.spacing, 1.0, closed=False)
    straight = gravity.value is not None and not any(gravity.value)
    return gravity.value if gravity.sure == "measured" or straight else None


def check_stated(motion: Motion) -> Iterator[Finding]:
    """Yields contradictions between the metadata and one trajectory: time step, gravity, particle volume."""
    yield from check_dt(motion)
    yield from check_gravity(motion)
    yield from check_volume(motion)


def find_odd_particles(motion: Motion) -> Iterator[Finding]:
    """Yields findings about particles that are where none should be, walls that move, overlaps and absences."""
    yield from find_particles_outside(motion)
    yield from find_moving_walls(motion)
    yield from find_overlaps(motion)
    yield from find_absences(motion)


def find_time_faults(motion: Motion) -> Iterator[Finding]:
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
        motion.where,
        f"frame {fault.frame}",
        fault.factor,
        badness=abs(fault.factor - 1),
    )


def check_dt(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if dt is not the step of recorded times, or if recorded velocities suit another one.

    Recorded times say what dt is. Without any, particles that fall by the stated gravity confirm it, and velocities
    that disagree are in another unit.
    """
    stated, dt = motion.metadata.dt, recorded_step(motion.trajectory)
    by_velocity = step_by_velocities([take_sample(motion.trajectory)] if "velocity" in motion.trajectory.fields else [])
    if dt is not None and abs(stated / dt - 1) > _UNEVEN and not _same(by_velocity, stated):
        yield _wrong_dt(motion, dt, "the recorded times of frames are {} apart")
    elif by_velocity is not None and not (_same(by_velocity, stated) or _same(by_velocity, 1.0)):
        if dt is None and "dt" not in motion.metadata.extra.get(FOUND, {}) and not _falls_by_gravity(motion):
            yield _wrong_dt(motion, by_velocity, "recorded velocities are displacements over {}")
            return
        by = "recorded times" if dt is not None else "the stated gravity" if _falls_by_gravity(motion) else "dt"
        yield Finding(
            "unit of velocities",
            Severity.NOTE,
            f"recorded velocities are displacements over {by_velocity:.4g}, frames are {stated:.4g} apart by {by};"
            " models use positions alone. For the velocities' unit of time: nmpm convert FOLDER NEW --dt"
            f" {by_velocity:.6g}.",
            motion.where,
            factor=stated / by_velocity,
        )


def _wrong_dt(motion: Motion, dt: float, reason: str) -> Finding:
    """The contradiction that dt is another one; `reason` says why, with a place for it."""
    factor = motion.metadata.dt / dt
    return Finding(
        "dt",
        Severity.CONTRADICTION,
        f"dt is stated as {motion.metadata.dt:.4g}, {too(factor)}: {reason.format(f'{dt:.4g}')}."
        f" {correction(f'--dt {dt:.6g}')}",
        motion.where,
        factor=factor,
        badness=abs(math.log(factor)),
    )


def _same(one: float | None, other: float) -> bool:
    return one is not None and abs(one / other - 1) < _SAME_NUMBER


def _falls_by_gravity(motion: Motion) -> bool:
    """Whether particles fall freely by the stated gravity, which then confirms dt."""
    stated, fall = trajectory_gravity(motion.trajectory.attributes, motion.metadata, motion.where), free_fall(motion)
    if stated is None or "gravity" in motion.metadata.extra.get(FOUND, {}) or fall is None or not any(fall):
        return False
    measured = np.asarray(fall) / motion.metadata.dt**2
    return bool(np.linalg.norm(np.asarray(stated) - measured) < (_DIFFERENT - 1) * np.linalg.norm(measured))


def check_gravity(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if particles do not fall freely by the stated gravity; then it is wrong, or dt is."""
    stated, fall = trajectory_gravity(motion.trajectory.attributes, motion.metadata, motion.where), free_fall(motion)
    if stated is None or fall is None:
        return
    if not any(fall):
        if any(stated):
            straight = f"gravity is stated as {_vector(stated)}, but in the first frames particles fly straight."
            zero = correction(f"--gravity={_comma(np.zeros(len(fall)))}")
            yield Finding("gravity", Severity.ODDITY, f"{straight} {zero}", motion.where)
        return
    recorded = recorded_step(motion.trajectory)
    dt = recorded or motion.metadata.dt
    measured = np.asarray(fall) / dt**2
    factor = float(np.linalg.norm(stated) / np.linalg.norm(measured))
    turned, resized = _compare_directions(stated, measured), _compare_sizes(factor)
    if not turned and not resized:
        return
    falls = f"in free fall particles accelerate by {_vector(measured)}"
    if not turned and recorded is None and _suggests_dt(stated, measured, math.sqrt(factor)):
        kind, number = "dt", math.sqrt(factor)
        sentence = (
            f"dt is stated as {dt:.4g}, {too(number)} if gravity is {_vector(stated)}: {falls}."
            f" {correction(f'--dt {dt / number:.4g}')} Else gravity is {too(factor)}."
        )
    else:
        kind, number = "gravity", factor
        values = np.where(np.abs(measured) > _PART * np.abs(measured).max(), measured, 0.0)
        sentence = (
            f"gravity is stated as {_vector(stated)}, {' and '.join(filter(None, (turned, resized)))}: {falls}."
            f" {correction(f'--gravity={_comma(values)}')}"
        )
    badness = abs(math.log(factor)) if factor else math.inf
    yield Finding(kind, Severity.CONTRADICTION, sentence, motion.where, factor=number or None, badness=badness)


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


def _compare_sizes(factor: float) -> str:
    """What is wrong with the size of a stated gravity that is not zero; empty if nothing is."""
    return "" if not factor or 1 / _DIFFERENT < factor < _DIFFERENT else too(factor)


def _suggests_dt(stated: Sequence[float], measured: np.ndarray, ratio: float) -> bool:
    """Whether a wrong dt is more likely than a wrong gravity: its factor is round, and the gravity is the Earth's."""
    simple = any(abs(max(ratio, 1 / ratio) / number - 1) < _SAME_NUMBER for number in _ROUND_FACTORS)
    return simple and (_is_earth(stated) or not _is_earth(measured))


def _is_earth(gravity: Sequence[float] | np.ndarray) -> bool:
    """Whether a gravity is the Earth's, in units that are powers of ten."""
    power = math.log10(float(np.linalg.norm(gravity)) / _EARTH)
    return abs(power - round(power)) < math.log10(1 + _SAME_NUMBER)


def check_volume(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if the stated particle volume is far from that of the densest of some frames."""
    stated, dim = motion.trajectory.attributes.get(VOLUME, motion.metadata.particle_volume), motion.metadata.dim
    measured = VOLUME in motion.metadata.extra.get(FOUND, {})  # in these trajectories
    if stated is None or measured or len(motion.index) < _LEAST_PARTICLES:
        return
    frames = np.unique(np.linspace(0, len(motion.position) - 1, _VOLUME_FRAMES).astype(int))
    spacings = [spacing_of(motion.position[frame], motion.metadata) for frame in frames]
    spacing = min((value for value in spacings if value), default=0.0)
    factor = stated / spacing**dim if spacing else 1.0
    too_large, too_small = _VOLUME
    if 1 / too_small < factor < too_large:
        return
    yield Finding(
        "particle volume",
        Severity.CONTRADICTION,
        f"particle_volume is stated as {stated:.3g}, {too(factor)}: particles are {spacing:.3g} apart, which makes"
        f" {spacing**dim:.3g}. Correct it in metadata.json, or remove it, so that it is measured.",
        motion.where,
        factor=factor,
        badness=abs(math.log(factor)),
    )


def find_particles_outside(motion: Motion) -> Iterator[Finding]:
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
        motion.where,
        f"frame {frame}, particle {particle}",
        badness=leaving,
    )


def find_moving_walls(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if particles of a static type move."""
    types, metadata = motion.trajectory.particle_type, motion.metadata
    mover = first_moving_particle(motion.trajectory.position, metadata.is_static(types), metadata.bounds)
    if mover is not None:
        name = metadata.particle_types[int(types[mover])]
        yield Finding(
            "moving walls",
            Severity.CONTRADICTION,
            f"it moves, though its type {types[mover]}, {name}, is static. If it is an obstacle that moves as recorded:"
            f" nmpm convert FOLDER NEW --prescribed {types[mover]}.",
            motion.where,
            f"particle {mover}",
        )


def find_overlaps(motion: Motion) -> Iterator[Finding]:
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
            motion.where,
            f"frame {frame}, particle {indices[first[int(np.argmax(number))]]}",
            badness=twins,
        )


def find_absences(motion: Motion) -> Iterator[Finding]:
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
        motion.where,
        badness=enter + leave + there.shape[1] * empty,
    )


def too(factor: float) -> str:
    """In words by how much a value is too large, or too small for a factor below 1."""
    return f"{factor:.4g} times too large" if factor > 1 else f"{1 / factor:.4g} times too small"


def correction(option: str) -> str:
    """The sentence that says how an option corrects the metadata."""
    return f"Correct it: nmpm convert FOLDER NEW {option}."


def _vector(values: Sequence[float] | np.ndarray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


def _comma(values: np.ndarray) -> str:
    return ",".join(f"{value:.4g}" for value in values)
