"""Recordings as tensors, and the windows that are gathered from them, also in the frames of a model.

With k frames of the model per frame of the data, a free fall has v_n = (x_n - x_{n-k}) / k + g (k - 1) / 2 in the
model's frame n, as x is quadratic in n: the velocity at a frame is the mean one since the last frame of the data, and
half of what the acceleration adds in between.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.machine import copy_to
from nmpm.errors import ConfigError, DataError
from nmpm.particles import Window
from nmpm.scene import Reading, Scene


@dataclass(frozen=True)
class Recording:
    """One trajectory of a known scene; all values are finite."""

    frames: Tensor  # (T, N, D) float32 positions of the moving particles that are ever there, in domain length
    material: Tensor  # (N,) int64 index into `Scene.materials`
    obstacle: Tensor  # (M, D) float32 positions of the obstacles in their first frame
    gravity: Tensor  # (D,) float32 in length per frame squared, zero where unknown
    fields: Mapping[str, Tensor] = field(default_factory=dict)  # float32 (T, N), (1, N) if constant in time, or (1, 1)
    present: Tensor | None = None  # (T, N) bool; None where all particles always are
    tracks: np.ndarray | None = None  # (K, 3) where some are absent, see `find_tracks`: a column may hold several
    obstacle_frames: Tensor | None = None  # (T, M, D) float32; None where no obstacle of the scene moves
    volume: Tensor | None = None  # (N,) float32 volumes as multiples of the scene's `particle_volume`; None for 1
    # (K + M, 2) column and first frame in the trajectory: of particles or tracks, then of obstacles
    source: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))


@dataclass(frozen=True)
class Presence:
    """The presence of a trajectory's particles, of N of which N' are there in some frame.

    Args:
        ever: (N,) whether each particle is there in any frame.
        present: (T, N') whether each of those is there in each frame.
    """

    ever: np.ndarray
    present: np.ndarray

    @classmethod
    def of(cls, position: np.ndarray) -> Presence | None:
        """The presence of particles from their (T, N, D) positions; None where all always are."""
        absent = np.isnan(position[..., 0])
        if not absent.any():
            return None
        ever = ~absent.all(axis=0)
        return cls(ever, ~absent[:, ever])

    def check(self, where: str) -> None:
        """Raises a DataError if no particle is there in two successive frames, so that none has a velocity."""
        if len(self.present) > 1 and not (self.present[1:] & self.present[:-1]).any():
            raise DataError(f"{where}: no particle is there in two successive frames. Remove the trajectory.")

    def fill(self, values: np.ndarray) -> np.ndarray:
        """(T, N', …) values, those of absent particles replaced by those they had last, or else will have first."""
        frames = np.where(self.present, np.arange(len(values))[:, None], -1)
        last = np.maximum.accumulate(frames, axis=0)
        source = np.where(last < 0, self.present.argmax(axis=0), last)
        return np.asarray(values[source, np.arange(values.shape[1])])


def obstacle_frames(position: np.ndarray, moving: bool) -> np.ndarray:
    """(T, M', D) positions of those of (T, M, D) obstacles that are ever there; where one is absent, it is as last.

    Of one frame, T = 1, where obstacles do not move.
    """
    if not moving and not np.isnan(position[0]).any():
        return position[:1]
    presence = Presence.of(position)
    return position if presence is None else presence.fill(position[:, presence.ever])


def find_tracks(present: np.ndarray, ids: np.ndarray | None = None) -> np.ndarray:
    """(K, 3) tracks: the column that holds the particle, and the first and the last frame in which it is there.

    Args:
        present: (T, N) whether the particle of each column is there in each frame.
        ids: (T, N) which particle that is, where columns hold several, one after the other; else each holds one.
    """
    column, frame = np.nonzero(present.T)
    other = np.diff(column, prepend=-1) != 0
    if ids is not None:
        other |= np.diff(ids[frame, column], prepend=0) != 0
    begins = np.flatnonzero(other)
    ends = np.append(begins[1:], len(frame)) - 1
    return np.stack([column[begins], frame[begins], frame[ends]], axis=1)


def first_frames(present: np.ndarray, length: int, every: int = 1) -> np.ndarray:
    """The first frame, for each of the windows of `length` frames, of the next window that has a velocity at its start.

    That is, of the next in whose first two frames some particle is there, or else of the last such window.

    Args:
        present: (T, N) whether each particle is there in each frame.
        length: Frames of a window.
        every: Frames from the window's first to its second.
    """
    windows = len(present) - length + 1
    inhabited = np.flatnonzero((present[every:] & present[:-every]).any(axis=1)[:windows])
    if not len(inhabited):
        return np.full(windows, windows - 1)
    following = np.searchsorted(inhabited, np.arange(windows))
    return np.asarray(inhabited[np.minimum(following, len(inhabited) - 1)])


_AT_REST = 1 / 8
"""Of the step that gravity alone gives: particles whose steps are shorter lie on something."""
_MOST_CHANGE = 0.5
"""Of a step by which the next may differ; of 0.25 to 1 the best for velocities of thinned grains, sand and water."""


def check_observed(horizon: int, reading: Reading) -> None:
    """Raise ConfigError if the data have none of the frames that a training step predicts."""
    if reading.between > horizon:
        raise ConfigError(
            f"The data have every {reading.between}th of the model's frames, none of the {horizon} that a training step"
            f" predicts: unroll at least {reading.between} frames (model.unroll, data.horizon)."
        )


def add_frames(window: Window, between: int, has_earlier: Tensor) -> Window:
    """A window of the model's frames, of one of the data's that has one frame more at its beginning.

    The second frame and every `between`-th after it are the data's, to the bit. Those in between are interpolated:
    positions so that constant accelerations are exact, fields and obstacles linearly. The first is such that the
    difference to the second is the best estimate of the velocity there.

    Args:
        window: (B, F, …) frames of the data, of which the third is the second of the result; gravity is in length per
            frame of the model squared.
        between: Frames of the model per frame of the data.
        has_earlier: (B,) whether the data have the first frame; otherwise it is of any value.
    """
    frames, present = window.frames, window.present
    there = torch.ones_like(frames[..., 0], dtype=torch.bool) if present is None else present
    there = torch.cat([there[:, :1] & has_earlier[:, None, None], there[:, 1:]], dim=1)
    throughout = (there[:, 2:] & there[:, 1:-1] & there[:, :-2]).unsqueeze(-1)
    change = frames.diff(n=2, dim=1)
    velocity = model_velocity(
        frames[:, 2] - frames[:, 1],
        change[:, 0].where(throughout[:, 0], torch.nan),
        window.gravity.unsqueeze(1) * between**2,
        1 / between,
    )

    def model_frames(values: Tensor, change: Tensor | None = None) -> Tensor:
        return interpolate(values[:, 1:], between, change)[:, between - 1 :]

    path = model_frames(frames, change.where(throughout, 0.0)[:, 1:])
    path[:, 0] = path[:, 1] - velocity
    observed = torch.zeros(path.shape[:2], dtype=torch.bool, device=path.device)
    observed[:, 1::between] = True
    moved, fields = window.obstacle_frames, window.fields
    return dataclasses.replace(
        window,
        frames=path,
        fields={n: v if v.shape[1] == 1 else model_frames(v) for n, v in fields.items()},
        present=None if present is None else model_frames(present.float()) == 1,
        obstacle_frames=None if moved is None else model_frames(moved),
        observed=observed,
    )


def model_velocity(step: Tensor, change: Tensor, gravity: Tensor, ratio: float) -> Tensor:
    """Velocity (…, N, D) at a frame, in length per frame of a model, from the last step between frames of the data.

    r Δ + r (1 - r) a / 2 with r frames of the data per frame of the model, exact at constant acceleration. That is the
    change of the steps, or gravity where none is known and the particle moves; but no more than gravity or half of the
    step, so that a collision is not extrapolated.

    Args:
        step: Δ (…, N, D) to this frame, in length per frame of the data.
        change: (…, N, D) by how much it differs from the step before; NaN where that is not known.
        gravity: (…, 1, D) in length per frame of the data squared.
        ratio: r.
    """
    pull, length = gravity.norm(dim=-1, keepdim=True), step.norm(dim=-1, keepdim=True)
    change = torch.where(change.isnan(), gravity * (length >= _AT_REST * pull), change)
    size, most = change.norm(dim=-1, keepdim=True), torch.maximum(pull, _MOST_CHANGE * length)
    change = torch.where(size > most, change * (most / size), change)
    return ratio * step + ratio * (1 - ratio) / 2 * change


def interpolate(values: Tensor, between: int, change: Tensor | None = None) -> Tensor:
    """Values at every frame of the model, (B, k (S - 1) + 1, …), of (B, S, …) at those of the data.

    Args:
        values: At S frames, 2 or more.
        between: k.
        change: (B, S - 2, …) second differences of the values, at all but the first and the last frame; linear between
            the frames when left out.
    """
    share = torch.arange(between, device=values.device, dtype=values.dtype) / between
    share = share.view(-1, *(1,) * (values.dim() - 2))
    path = values[:, :-1].unsqueeze(2) + share * values.diff(dim=1).unsqueeze(2)
    if change is not None and change.shape[1]:
        first = torch.cat([change[:, :1], change], dim=1)
        last = torch.cat([change, change[:, -1:]], dim=1)
        path = path + share * (share - 1) / 4 * (first + last).unsqueeze(2)
    return torch.cat([path.flatten(1, 2), values[:, -1:]], dim=1)


@dataclass(frozen=True)
class PaddedRecordings:
    """S recordings of a scene, padded to the longest and largest; padding particles are at the domain's centre.

    Args:
        whole: Tensors (S, …) of all frames of the data; not unwrapped, and without what lies between these frames.
        reading: The recordings' scene, and how windows are taken out of the frames.
        tracks: (S, K, 3) the recordings' tracks, padded with such that are never there; None where all particles
            always are.
    """

    whole: Window
    reading: Reading
    tracks: np.ndarray | None = None

    @classmethod
    def stack(cls, recordings: Sequence[Recording], reading: Reading) -> PaddedRecordings:
        """Copies recordings into padded tensors; raises a DataError if not all have the same kinds of fields."""
        recordings = _with_the_same_tensors(recordings)
        centre = [(low + high) / 2 for low, high in reading.scene.domain]
        fillers = {"frames": centre, "obstacle": centre, "obstacle_frames": centre, "volume": 1}
        tensors = {
            name: torch.from_numpy(_stack([getattr(each, name).numpy() for each in recordings], fillers.get(name, 0)))
            for name, value in vars(recordings[0]).items()
            if isinstance(value, Tensor)
        }
        for mask, name in (("mask", "material"), ("obstacle_mask", "obstacle")):
            real = [np.ones(len(getattr(each, name)), bool) for each in recordings]
            tensors[mask] = torch.from_numpy(_stack(real, False))
        tracks = None if recordings[0].tracks is None else _stack([each.tracks for each in recordings], _NO_TRACK)
        return cls(Window(fields=_stack_fields(recordings), **tensors), reading, tracks)

    def recording(self, row: int, original: Recording) -> Recording:
        """A view of one row's particles without its padding; `original` is the recording that was stacked there."""

        def view(padded: Tensor, values: Tensor) -> Tensor:
            return padded[row][_corner(values.shape)]

        views: dict[str, Any] = {
            n: view(getattr(self.whole, n), v) for n, v in vars(original).items() if isinstance(v, Tensor)
        }
        fields = {name: view(self.whole.fields[name], values) for name, values in original.fields.items()}
        return replace(original, **views, fields=fields)

    def to(self, device: torch.device) -> PaddedRecordings:
        """Copies the tensors to a device; tensors that are there already are shared."""
        return replace(self, whole=self.whole.to(device))

    def gather(self, rows: Sequence[int], starts: Sequence[int], length: int, particles: int | None = None) -> Window:
        """Gathers `length` consecutive frames of B recordings, by their rows and first frames.

        On the scene's periodic axes positions are unwrapped from the first frame on, so that differences between frames
        are displacements. Windows are padded to a number of particles, without those that are there only before or
        only after the window; when it is left out, all particles of the largest recording are in the windows.

        Rows, first frames and `length` are the data's; the windows' frames are the model's.
        """
        whole, device = self.whole, self.whole.frames.device
        row, first = (copy_to(torch.as_tensor(numbers), device) for numbers in (rows, starts))
        every, between, scene = self.reading.every, self.reading.between, self.reading.scene
        frame = first[:, None] + torch.arange(0 if between == 1 else -1, length, device=device)
        frame = frame.clamp(min=0)
        if self.tracks is None:
            window = self._gather(row, frame, slice(particles))
        else:
            tracks = _tracks_in_windows(self.tracks[rows], starts, length, particles)
            window = self._gather_tracks(row, frame, torch.as_tensor(tracks))
        unwrap(window.frames, scene)
        if whole.obstacle_frames is not None:
            window.obstacle_frames = whole.obstacle_frames[row[:, None], frame]
            unwrap(window.obstacle_frames, scene)
        if every > 1:
            window = window.pick_frames(slice(None, None, every))
        if between > 1:
            window = add_frames(window, between, first > 0)
        if window.obstacle_frames is not None:
            window.obstacle = window.obstacle_frames[:, 1]
        return window

    def _gather(self, row: Tensor, frame: Tensor, columns: slice) -> Window:
        """The windows of (B,) rows and (B, T) frames with some particles, the same ones for all rows."""

        def of_frames(values: Tensor) -> Tensor:
            each = values[:, :, columns]
            return each[row] if values.shape[1] == 1 else each[row[:, None], frame]

        return self._window(row, lambda values: values[:, columns][row], of_frames)

    def _gather_tracks(self, row: Tensor, frame: Tensor, tracks: Tensor) -> Window:
        """The windows of (B,) rows and (B, T) frames with (B, N', 3) of their tracks; a column of −1 is padding."""
        column, first, last = copy_to(tracks, row.device).unbind(dim=-1)
        real, column = column >= 0, column.clamp(min=0)
        # Before and after its track a particle is where that begins and ends.
        nearest = torch.minimum(torch.maximum(frame[:, :, None], first[:, None]), last[:, None])
        each_row, each = row[:, None, None], column[:, None]
        there = real[:, None] & (nearest == frame[:, :, None])

        def of_frames(values: Tensor) -> Tensor:
            return _take(values, each_row, nearest if values.shape[1] > 1 else 0, each if values.shape[2] > 1 else 0)

        window = self._window(row, lambda values: values[row[:, None], column], of_frames)
        window.mask = real
        window.present = there if self.whole.present is None else there & of_frames(self.whole.present)
        return window

    def _window(
        self, row: Tensor, of_particles: Callable[[Tensor], Tensor], of_frames: Callable[[Tensor], Tensor]
    ) -> Window:
        """The windows of (B,) rows, given what picks their entries of (S, N) and of (S, T, N, …) values."""
        whole = self.whole
        return Window(
            frames=of_frames(whole.frames),
            material=of_particles(whole.material),
            mask=of_particles(whole.mask),
            obstacle=whole.obstacle[row],
            obstacle_mask=whole.obstacle_mask[row],
            gravity=whole.gravity[row],
            fields={name: of_frames(values) for name, values in whole.fields.items()},
            volume=None if whole.volume is None else of_particles(whole.volume),
        )


def collate(recordings: Sequence[Recording], reading: Reading, length: int | None = None) -> Window:
    """Makes one batch of the first `length` frames of B recordings; of all frames, equally many, when None.

    Returns:
        Window: padded to the largest recording. `length` counts frames of the model; the window goes on to the next
            frame that the data have.
    """
    frames = len(recordings[0].frames) if length is None else reading.data_frames(length)
    return PaddedRecordings.stack(recordings, reading).gather(range(len(recordings)), [0] * len(recordings), frames)


def pin_for(device: torch.device, batches: Iterator[Window]) -> Iterator[Window]:
    """Pins batches in host memory where they will be copied to a GPU, so that its work overlaps with the copies."""
    return map(Window.pin_memory, batches) if device.type == "cuda" else batches


def unwrap(frames: Tensor, scene: Scene) -> None:
    """Removes the jumps of (B, T, N, D) positions across periodic borders, in place, by minimum image.

    The first frame stays as it is; later ones may be outside of the domain, by whole periods.
    """
    for axis, (low, high) in enumerate(scene.domain):
        if scene.periodic[axis]:
            period = high - low
            along = frames[..., axis]
            turns = torch.round(along.diff(dim=1) / period).cumsum(dim=1)
            along[:, 1:] -= turns * period


def displacements(frames: Tensor, scene: Scene) -> Tensor:
    """Displacements (T - 1, N, D) between frames (T, N, D), by minimum image on periodic axes."""
    steps = frames.diff(dim=0)
    for axis, (low, high) in enumerate(scene.domain):
        if scene.periodic[axis]:
            period, along = high - low, steps[..., axis]
            along -= torch.round(along / period) * period
    return steps


def _take(values: Tensor, row: Tensor, frame: Tensor | int, column: Tensor | int) -> Tensor:
    """Entries of (S, T, N, …) values at indices that broadcast; several times as fast as indexing by three tensors."""
    index = (row * values.shape[1] + frame) * values.shape[2] + column
    taken: Tensor = values.flatten(0, 2).index_select(0, index.flatten()).unflatten(0, index.shape)
    return taken


_NO_TRACK = (-1, 0, 0)
"""Padding among tracks: no column, and a frame that exists."""


def _with_the_same_tensors(recordings: Sequence[Recording]) -> Sequence[Recording]:
    """The recordings, all with presence, tracks and volumes where one has them, and with obstacles that move or not."""
    defaults: dict[str, Callable[[Recording], Any]] = {
        "present": lambda recording: torch.ones(recording.frames.shape[:2], dtype=torch.bool),
        "tracks": lambda recording: find_tracks(recording.present.numpy()),  # type: ignore[union-attr]
        "volume": lambda recording: torch.ones(len(recording.material)),
    }
    for name, default in defaults.items():
        values = [getattr(recording, name) for recording in recordings]
        if any(value is not None for value in values):
            values = [default(each) if value is None else value for each, value in zip(recordings, values, strict=True)]
            recordings = [replace(each, **{name: value}) for each, value in zip(recordings, values, strict=True)]
    if any(recording.obstacle_frames is None for recording in recordings):
        recordings = [replace(recording, obstacle_frames=None) for recording in recordings]
    return recordings


def _stack_fields(recordings: Sequence[Recording]) -> dict[str, Tensor]:
    """By name (S, T, N), (S, 1, N) or (S, 1, 1); zero in padding."""
    stacked = {}
    for name in dict.fromkeys(name for recording in recordings for name in recording.fields):
        having = [recording for recording in recordings if name in recording.fields]
        parts = [recording.fields[name].numpy() for recording in having]
        constant = {part.shape[0] == 1 for part in parts}
        # Of one particle, both kinds look the same.
        single = {part.shape[1] == 1 for part, one in zip(parts, having, strict=True) if len(one.material) > 1}
        if len(parts) < len(recordings) or len(constant) > 1 or len(single) > 1:
            raise DataError(
                f"The field {name} has another shape in some trajectories than in others, or is missing in some: store"
                " it in all as (T, N), as (N,), or as one number."
            )
        stacked[name] = torch.from_numpy(_stack(parts, 0))
    return stacked


def _tracks_in_windows(tracks: np.ndarray, starts: Sequence[int], length: int, count: int | None) -> np.ndarray:
    """(B, count, 3) tracks, of (B, K, 3) ones, that overlap windows, padded; all K when the count is None."""
    if count is None:
        return tracks
    result = np.full((len(tracks), count, 3), _NO_TRACK)
    for row, (own, start) in enumerate(zip(tracks, starts, strict=True)):
        within = own[overlap(own, start, length)]
        result[row, : len(within)] = within
    return result


def overlap(tracks: np.ndarray, start: int, length: int) -> np.ndarray:
    """(K,) whether (K, 3) tracks overlap the window of `length` frames from `start` on."""
    return np.asarray((tracks[:, 0] >= 0) & (tracks[:, 1] < start + length) & (tracks[:, 2] >= start))


def _stack(parts: Sequence[Any], filler: Any) -> np.ndarray:
    """Stacks arrays, each padded to the largest along each axis by a filler, which broadcasts."""
    # NumPy copies in this thread; PyTorch would occupy its thread pool, which training needs.
    padded = np.empty((len(parts), *np.max([part.shape for part in parts], axis=0)), dtype=parts[0].dtype)
    padded[:] = filler
    for row, part in zip(padded, parts, strict=True):
        row[_corner(part.shape)] = part
    return padded


def _corner(shape: Sequence[int]) -> tuple[slice, ...]:
    """Index of the first entries along each axis."""
    return tuple(map(slice, shape))
