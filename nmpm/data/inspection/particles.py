"""Finds particles that are odd in one trajectory: walls that move, particles at the same place, or not always there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.inspection.findings import Finding, Severity
from nmpm.data.inspection.motion import Motion
from nmpm.data.statistics import first_moving_particle, first_outside


def find_odd_particles(motion: Motion) -> Iterator[Finding]:
    """Yields findings about the particles of one trajectory."""
    yield from find_particles_outside(motion)
    yield from find_moving_walls(motion)
    yield from find_overlaps(motion)
    yield from find_absences(motion)


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
