"""Trajectories at even times, and with less measurement noise.

Both work on the pieces of a particle's track between absences, each for itself: nothing is interpolated across a gap.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from nmpm._support.messages import counted
from nmpm.data.array_checks import broken_frames, particles_far_away
from nmpm.data.convert.base import UNKNOWN_LENGTH, ForeignDataset, Options
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.samples import take_sample
from nmpm.data.times import (
    find_time_fault,
    increasing_frames,
    recorded_times,
    step_by_velocities,
    take_frames,
    usual_step,
)
from nmpm.errors import DataError

_log = logging.getLogger(__name__)

_GAP = 2.5  # longer steps in time, in usual or new ones, are gaps
_TOLERANCE = 0.05  # of a step: further from a piece's ends than that, there is no particle
_ORDER = 2  # of the polynomials of smoothing
_VALUES = 2**22  # numbers that are interpolated at once

Piece = tuple[int, int]
"""First frame, and the frame after the last."""


def retime(dataset: ForeignDataset, options: Options) -> ForeignDataset:
    """The dataset at the even times and with the smoothing that a user asks for; a stated dt overrules recorded times.

    Raises:
        DataError: on reading, if there are no times to resample.
    """
    if options.dt is not None:
        dataset = dataset.map(lambda run: replace(run, fields={n: v for n, v in run.fields.items() if n != "time"}))
    if options.resample is not None:
        if dataset.steps:
            dataset = dataset.map(_with_steps_as_times)
        dt = None if "dt" in dataset.unknown else dataset.metadata.dt
        metadata = replace(dataset.metadata, dt=options.resample, sequence_length=UNKNOWN_LENGTH)
        step = options.resample

        def resampled(trajectory: Trajectory) -> Trajectory:
            if (time := recorded_times(trajectory)) is None:
                if dt is None:
                    raise DataError("Frames without times cannot be resampled: state the time between them (--dt).")
                time = dt * np.arange(len(trajectory.position))
            return resample(*_in_order(trajectory, time), step, metadata)

        dataset = dataset.map(resampled, metadata)
        note = f"Positions are interpolated to frames that are {options.resample:g} apart in time."
        dataset = replace(dataset, notes=(*dataset.notes, note), unknown=dataset.unknown - {"dt"})
    if options.smooth is not None:
        dataset = dataset.map(partial(smooth, frames=options.smooth, metadata=dataset.metadata))
        note = f"Positions are smoothed by quadratic fits to {options.smooth} frames; errors are against these."
        dataset = replace(dataset, notes=(*dataset.notes, note))
    return dataset


def _with_steps_as_times(trajectory: Trajectory) -> Trajectory:
    """The trajectory with times in place of numbers of steps, where velocities tell how long a step is."""
    numbers, by_velocity = recorded_times(trajectory), step_by_velocities([take_sample(trajectory)])
    if numbers is None or by_velocity is None:
        return trajectory
    return replace(trajectory, fields=trajectory.fields | {"time": numbers * (by_velocity / usual_step(numbers))})


def _in_order(trajectory: Trajectory, time: np.ndarray) -> tuple[Trajectory, np.ndarray]:
    """The trajectory and its (T,) times without frames that are no data, and those that a restart has written again.

    Particles that are absurdly far away are absent.

    Raises:
        DataError: if there is more than one run in it.
    """
    good = np.flatnonzero(~broken_frames(trajectory.position) & np.isfinite(time))
    if not len(good):
        raise DataError("In all frames all particles are at one point.")
    kept = good[increasing_frames(time[good])]
    if 2 * len(kept) <= len(good):
        fault = find_time_fault(time[good])
        raise DataError(f"Frames cannot be put in order: {fault.sentence} {fault.remedy}" if fault else "")
    if left_out := len(time) - len(kept):
        _log.warning(
            "%s left out: particles at one point or far away, or without a time (%d), times that do not increase (%d).",
            counted(left_out, "frame"), len(time) - len(good), len(good) - len(kept),
        )  # fmt: skip
        trajectory = take_frames(trajectory, kept)
    if (far := particles_far_away(trajectory.position)).any():
        _log.warning("%s far away: absent there.", counted(int(far.any(axis=0).sum()), "particle"))
        position = np.where(far[..., None], np.float32(np.nan), trajectory.position)
        trajectory = replace(trajectory, position=position)
    return trajectory, time[kept]


def resample(trajectory: Trajectory, time: np.ndarray, step: float, metadata: Metadata) -> Trajectory:
    """The trajectory at even times, by cubic splines through the frames of each particle, never across gaps.

    Gaps are frames in which a particle is absent, and times between frames that are longer than 2.5 usual or new steps.
    Fields of particles that are no floats have the value of the nearest frame.

    Args:
        trajectory: The trajectory.
        time: (T,) times of its frames.
        step: Time between the new frames; the first is the first that is recorded.
        metadata: The dataset's; on periodic axes splines go the short way across the border.

    Raises:
        DataError: if the times do not increase, or are shorter than two steps.
    """
    steps, (frames, particles) = np.diff(time), trajectory.position.shape[:2]
    if not (steps > 0).all():
        frame = int(np.argmin(steps > 0)) + 1
        raise DataError(f"The times of frames must increase to be resampled; that of frame {frame} is {time[frame]:g}.")
    new = time[0] + step * np.arange(int((time[-1] - time[0]) / step + _TOLERANCE) + 1)
    if len(new) < 2:
        raise DataError(f"Frames from {time[0]:g} to {time[-1]:g} cannot be resampled to steps of {step:g}.")
    breaks = 1 + np.flatnonzero(steps > _GAP * max(float(np.median(steps)), step))
    nearest = np.abs(time[:, None] - new).argmin(axis=0)

    def spline(piece: Piece, tracks: np.ndarray) -> tuple[slice, np.ndarray]:
        recorded, tolerance = time[slice(*piece)], _TOLERANCE * step
        first, last = np.searchsorted(new, [recorded[0] - tolerance, recorded[-1] + tolerance]).tolist()
        if len(recorded) == 1:
            return slice(first, last), np.broadcast_to(tracks, (last - first, *tracks.shape[1:]))
        return slice(first, last), CubicSpline(recorded, tracks)(new[first:last])

    position = _by_pieces(trajectory.position, breaks, len(new), spline, metadata)
    end = int(np.flatnonzero(~np.isnan(position[..., 0]).all(axis=1))[-1]) + 1
    fields = {"time": new[:end]}
    for name, values in trajectory.fields.items():
        if values.shape[:2] == (frames, particles) and values.dtype.kind == "f":
            fields[name] = _by_pieces(values, breaks, len(new), spline)[:end]
        elif values.shape[:2] == (frames, particles) or (values.shape == (frames,) and frames != particles):
            fields.setdefault(name, values[nearest][:end])
        else:
            fields.setdefault(name, values)
    return replace(trajectory, position=position[:end], fields=fields)


def smooth(trajectory: Trajectory, frames: int, metadata: Metadata) -> Trajectory:
    """The trajectory with each position replaced by a quadratic fit to the frames around it (Savitzky and Golay).

    At the ends of tracks and at gaps the fits are one-sided; pieces with fewer frames are one parabola, those with
    three or less stay as they are. Fields are not smoothed.
    """

    def fit(piece: Piece, tracks: np.ndarray) -> tuple[slice, np.ndarray]:
        if len(tracks) >= frames:
            tracks = savgol_filter(tracks, frames, _ORDER, axis=0, mode="interp")
        elif len(tracks) > _ORDER + 1:
            basis, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, len(tracks)), _ORDER + 1))
            tracks = basis @ (basis.T @ tracks)
        return slice(*piece), tracks

    position = trajectory.position
    return replace(trajectory, position=_by_pieces(position, np.empty(0, int), len(position), fit, metadata))


def _by_pieces(
    values: np.ndarray,
    breaks: np.ndarray,
    length: int,
    change: Callable[[Piece, np.ndarray], tuple[slice, np.ndarray]],
    metadata: Metadata | None = None,
) -> np.ndarray:
    """(T', N, …) values of the same type: the pieces of (T, N, …) ones, each changed; NaN between them.

    Args:
        values: NaN where a particle is absent.
        breaks: Frames at which pieces end also where the particle is there.
        length: T'.
        change: Called with a piece and its (n, N' C) float64 values; returns which frames it gives, and their values.
        metadata: Of positions: jumps across the borders of periodic axes are removed, and results within the bounds.
    """
    frames, particles = values.shape[:2]
    flat = values.reshape(frames, particles, -1)
    lower, upper = np.asarray(metadata.bounds).T if metadata else np.zeros((2, 0))
    periodic = np.flatnonzero(metadata.periodic) if metadata else np.zeros(0, int)
    result = np.full((length, particles, flat.shape[2]), np.nan, values.dtype)
    for piece, index in _pieces(~np.isnan(flat[..., 0]), breaks):
        most = max(1, _VALUES // (max(piece[1] - piece[0], length) * flat.shape[2]))
        for some in np.split(index, range(most, len(index), most)):
            tracks = flat[piece[0] : piece[1], some].astype(np.float64)
            for axis in periodic:
                tracks[..., axis] = np.unwrap(tracks[..., axis], period=upper[axis] - lower[axis], axis=0)
            target, changed = change(piece, tracks.reshape(len(tracks), -1))
            result[target, some] = changed.reshape(len(changed), len(some), -1)
    for axis in periodic:
        result[..., axis] = lower[axis] + np.mod(result[..., axis] - lower[axis], upper[axis] - lower[axis])
    return result.reshape(length, particles, *values.shape[2:])


def _pieces(present: np.ndarray, breaks: np.ndarray) -> Iterator[tuple[Piece, np.ndarray]]:
    """The pieces of the tracks by (T, N) presence, and the particles that have each."""
    first, last = present.copy(), present.copy()
    first[1:] &= ~present[:-1]
    last[:-1] &= ~present[1:]
    first[breaks] = present[breaks]
    last[breaks - 1] = present[breaks - 1]
    particle, start = np.nonzero(first.T)
    _, end = np.nonzero(last.T)
    pieces, number = np.unique(np.stack([start, end + 1], axis=1), axis=0, return_inverse=True)
    order = np.argsort(number.reshape(-1), kind="stable")
    bounds = np.searchsorted(number.reshape(-1)[order], np.arange(len(pieces) + 1))
    for (begin, stop), low, high in zip(pieces.tolist(), bounds[:-1], bounds[1:], strict=True):
        yield (begin, stop), particle[order[low:high]]
