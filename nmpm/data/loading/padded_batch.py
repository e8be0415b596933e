"""Recordings stacked into one padded tensor, from which windows are gathered in one indexing operation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.devices import copy_to
from nmpm.data.loading.model_frames import add_frames
from nmpm.data.loading.presence import find_tracks
from nmpm.data.loading.recording import Recording
from nmpm.errors import DataError
from nmpm.particles import Window
from nmpm.scene import Reading, Scene

_NO_TRACK = (-1, 0, 0)
"""Padding among tracks: no column, and a frame that exists."""


@dataclass(frozen=True)
class PaddedRecordings:
    """S recordings of a scene, padded to the longest and largest; padding particles are at the domain's centre.

    Args:
        frames: (S, T, N, D) positions, in domain length, in all frames of the data.
        material, mask, obstacle, obstacle_mask, gravity, fields, present, obstacle_frames, volume: as in `Window`, with
            S in place of B.
        tracks: (S, K, 3) the recordings' tracks, padded with such that are never there; None where all particles
            always are.
        reading: The recordings' scene, and how windows are taken out of the frames.
    """

    frames: Tensor
    material: Tensor
    mask: Tensor
    obstacle: Tensor
    obstacle_mask: Tensor
    gravity: Tensor
    reading: Reading
    fields: Mapping[str, Tensor] = field(default_factory=dict)
    present: Tensor | None = None
    obstacle_frames: Tensor | None = None
    volume: Tensor | None = None
    tracks: np.ndarray | None = None

    @classmethod
    def stack(cls, recordings: Sequence[Recording], reading: Reading) -> PaddedRecordings:
        """Copies recordings into padded tensors; raises a DataError if not all have the same kinds of fields."""
        centre = [(low + high) / 2 for low, high in reading.scene.domain]
        frames, mask = _pad_and_stack([recording.frames for recording in recordings], centre)
        obstacle, obstacle_mask = _pad_and_stack([recording.obstacle[None] for recording in recordings], centre)
        material, _ = _pad_and_stack([recording.material[None, :, None] for recording in recordings], [0])
        gravity = torch.stack([recording.gravity for recording in recordings])
        return cls(
            frames=frames,
            material=material[:, 0, :, 0],
            mask=mask,
            obstacle=obstacle[:, 0],
            obstacle_mask=obstacle_mask,
            gravity=gravity,
            reading=reading,
            fields=_stack_fields(recordings),
            **_stack_presence(recordings),
            obstacle_frames=_stack_obstacle_frames(recordings, centre),
            volume=_stack_volumes(recordings),
        )

    def recording(self, row: int, original: Recording) -> Recording:
        """A view of one row's particles without its padding; `original` is the recording that was stacked there."""
        frames, count, _ = original.frames.shape
        return Recording(
            frames=self.frames[row, :frames, :count],
            material=self.material[row, :count],
            obstacle=self.obstacle[row, : len(original.obstacle)],
            gravity=self.gravity[row],
            fields={
                name: self.fields[name][row, : values.shape[0], : values.shape[1]]
                for name, values in original.fields.items()
            },
            present=None if original.present is None or self.present is None else self.present[row, :frames, :count],
            tracks=original.tracks,
            obstacle_frames=original.obstacle_frames,
            volume=original.volume,
        )

    def to(self, device: torch.device) -> PaddedRecordings:
        """Copies the tensors to a device; tensors that are there already are shared."""
        tensors: dict[str, Any] = {k: value.to(device) for k, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **tensors, fields={name: values.to(device) for name, values in self.fields.items()})

    def gather(self, rows: Sequence[int], starts: Sequence[int], length: int, particles: int | None = None) -> Window:
        """Gathers `length` consecutive frames of B recordings, by their rows and first frames.

        On the scene's periodic axes positions are unwrapped from the first frame on, so that differences between frames
        are displacements. Windows are padded to a number of particles, without those that are there only before or
        only after the window; when it is left out, all particles of the largest recording are in the windows.

        Rows, first frames and `length` are the data's; the windows' frames are the model's.
        """
        row = copy_to(torch.as_tensor(rows), self.frames.device)
        first = copy_to(torch.as_tensor(starts), self.frames.device)
        every, between, scene = self.reading.every, self.reading.between, self.reading.scene
        frame = first[:, None] + torch.arange(0 if between == 1 else -1, length, device=self.frames.device)
        frame = frame.clamp(min=0)
        if self.tracks is None:
            window = self._gather_columns(row, frame, slice(particles))
        else:
            tracks = _tracks_in_windows(self.tracks[rows], starts, length, particles)
            window = self._gather_tracks(row, frame, copy_to(torch.as_tensor(tracks), self.frames.device))
        unwrap(window.frames, scene)
        if self.obstacle_frames is not None:
            window.obstacle_frames = self.obstacle_frames[row[:, None], frame]
            unwrap(window.obstacle_frames, scene)
        if every > 1:
            window = window.pick_frames(slice(None, None, every))
        if between > 1:
            window = add_frames(window, between, first > 0)
        if window.obstacle_frames is not None:
            window.obstacle = window.obstacle_frames[:, 1]
        return window

    def _gather_columns(self, row: Tensor, frame: Tensor, kept: slice) -> Window:
        """The windows of (B,) rows and (B, T) frames with some particles, the same ones for all rows."""
        return Window(
            frames=self.frames[:, :, kept][row[:, None], frame],
            material=self.material[:, kept][row],
            mask=self.mask[:, kept][row],
            obstacle=self.obstacle[row],
            obstacle_mask=self.obstacle_mask[row],
            gravity=self.gravity[row],
            fields={
                name: values[:, :, kept][row] if values.shape[1] == 1 else values[:, :, kept][row[:, None], frame]
                for name, values in self.fields.items()
            },
            volume=None if self.volume is None else self.volume[:, kept][row],
        )

    def _gather_tracks(self, row: Tensor, frame: Tensor, tracks: Tensor) -> Window:
        """The windows of (B,) rows and (B, T) frames with (B, N', 3) of their tracks; a column of −1 is padding."""
        column, first, last = tracks.unbind(dim=-1)
        real, column = column >= 0, column.clamp(min=0)
        # Before and after its track a particle is where that begins and ends.
        nearest = torch.minimum(torch.maximum(frame[:, :, None], first[:, None]), last[:, None])
        scene, each = row[:, None, None], column[:, None]
        there = real[:, None] & (nearest == frame[:, :, None])
        return Window(
            frames=_take(self.frames, scene, nearest, each),
            material=self.material[row[:, None], column],
            mask=real,
            obstacle=self.obstacle[row],
            obstacle_mask=self.obstacle_mask[row],
            gravity=self.gravity[row],
            fields={
                name: _take(values, scene, nearest if values.shape[1] > 1 else 0, each if values.shape[2] > 1 else 0)
                for name, values in self.fields.items()
            },
            present=there if self.present is None else there & _take(self.present, scene, nearest, each),
            volume=None if self.volume is None else self.volume[row[:, None], column],
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


def _stack_fields(recordings: Sequence[Recording]) -> dict[str, Tensor]:
    """By name (S, T, N), (S, 1, N) or (S, 1, 1); zero in padding."""
    stacked = {}
    for name in dict.fromkeys(name for recording in recordings for name in recording.fields):
        having = [recording for recording in recordings if name in recording.fields]
        parts = [recording.fields[name] for recording in having]
        constant = {part.shape[0] == 1 for part in parts}
        # Of one particle, both kinds look the same.
        single = {part.shape[1] == 1 for part, one in zip(parts, having, strict=True) if len(one.material) > 1}
        if len(parts) < len(recordings) or len(constant) > 1 or len(single) > 1:
            raise DataError(
                f"The field {name} has another shape in some trajectories than in others, or is missing in some: store"
                " it in all as (T, N), as (N,), or as one number."
            )
        stacked[name] = _pad_and_stack([part.unsqueeze(-1) for part in parts], [0.0])[0].squeeze(-1)
    return stacked


def _stack_presence(recordings: Sequence[Recording]) -> dict[str, Any]:
    """`present` and `tracks` of `PaddedRecordings`; nothing where all particles always are there."""
    if all(recording.present is None for recording in recordings):
        return {}
    parts = [
        torch.ones(recording.frames.shape[:2], dtype=torch.bool) if recording.present is None else recording.present
        for recording in recordings
    ]
    tracks = [
        find_tracks(part.numpy()) if recording.tracks is None else recording.tracks
        for part, recording in zip(parts, recordings, strict=True)
    ]
    padded = np.full((len(tracks), max(map(len, tracks)), 3), _NO_TRACK)
    for row, own in enumerate(tracks):
        padded[row, : len(own)] = own
    return {"present": _pad_and_stack([part.unsqueeze(-1) for part in parts], [False])[0].squeeze(-1), "tracks": padded}


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


def _stack_obstacle_frames(recordings: Sequence[Recording], centre: Sequence[float]) -> Tensor | None:
    """(S, T, M, D) positions of obstacles that move; None where there are none."""
    parts = [recording.obstacle_frames for recording in recordings if recording.obstacle_frames is not None]
    return _pad_and_stack(parts, centre)[0] if len(parts) == len(recordings) else None


def _stack_volumes(recordings: Sequence[Recording]) -> Tensor | None:
    """(S, N) relative volumes, 1 in padding and where a recording has none; None where none has."""
    if all(recording.volume is None for recording in recordings):
        return None
    parts = [
        torch.ones(len(recording.material)) if recording.volume is None else recording.volume
        for recording in recordings
    ]
    return _pad_and_stack([part[None, :, None] for part in parts], [1.0])[0][:, 0, :, 0]


def _pad_and_stack(parts: Sequence[Tensor], filler: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Stacks (T_i, N_i, C) tensors to (S, T, N, C), and a mask (S, N) that is False for padding."""
    counts = [part.shape[1] for part in parts]
    longest = max(part.shape[0] for part in parts)
    # NumPy copies in this thread; PyTorch would occupy its thread pool, which training needs.
    padded = np.empty((len(parts), longest, max(counts), len(filler)), dtype=parts[0].numpy().dtype)
    padded[:] = filler
    for row, (part, count) in enumerate(zip(parts, counts, strict=True)):
        padded[row, : part.shape[0], :count] = part.numpy()
    mask = np.arange(max(counts)) < np.asarray(counts)[:, None]
    return torch.from_numpy(padded), torch.from_numpy(mask)
