"""Recordings stacked into one padded tensor, from which windows are gathered in one indexing operation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm.data.loading.recording import Recording
from nmpm.errors import DataError
from nmpm.particles import Window
from nmpm.scene import Scene


@dataclass(frozen=True)
class PaddedRecordings:
    """S recordings of a scene, padded to the longest and largest; padding particles are at the domain's centre.

    Args:
        frames: (S, T, N, D) positions, in domain length.
        material, mask, obstacle, obstacle_mask, gravity, fields: as in `Window`, with S in place of B.
        scene: The recordings' scene.
    """

    frames: Tensor
    material: Tensor
    mask: Tensor
    obstacle: Tensor
    obstacle_mask: Tensor
    gravity: Tensor
    scene: Scene
    fields: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def stack(cls, recordings: Sequence[Recording], scene: Scene) -> PaddedRecordings:
        """Copies recordings into padded tensors; raises a DataError if not all have the same kinds of fields."""
        centre = [(low + high) / 2 for low, high in scene.domain]
        frames, mask = _pad_and_stack([recording.frames for recording in recordings], centre)
        obstacle, obstacle_mask = _pad_and_stack([recording.obstacle[None] for recording in recordings], centre)
        material, _ = _pad_and_stack([recording.material[None, :, None] for recording in recordings], [0])
        gravity = torch.stack([recording.gravity for recording in recordings])
        fields = _stack_fields(recordings)
        return cls(frames, material[:, 0, :, 0], mask, obstacle[:, 0], obstacle_mask, gravity, scene, fields)

    def recording(self, row: int, original: Recording) -> Recording:
        """A view of one row without its padding; `original` is the recording that was stacked there."""
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
        )

    def to(self, device: torch.device) -> PaddedRecordings:
        """Copies the tensors to a device; tensors that are there already are shared."""
        tensors: dict[str, Any] = {k: value.to(device) for k, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **tensors, fields={name: values.to(device) for name, values in self.fields.items()})

    def gather(self, rows: Sequence[int], starts: Sequence[int], length: int, particles: int | None = None) -> Window:
        """Gathers `length` consecutive frames of B recordings, by their rows and first frames.

        On the scene's periodic axes positions are unwrapped from the first frame on, so that differences between frames
        are displacements. Windows are padded to a number of particles, the largest recording's if left out.
        """
        row = _index_tensor(rows, self.frames.device)
        first = _index_tensor(starts, self.frames.device)
        frame = first[:, None] + torch.arange(length, device=self.frames.device)
        kept = slice(particles)
        frames = self.frames[:, :, kept][row[:, None], frame]
        unwrap(frames, self.scene)
        return Window(
            frames=frames,
            material=self.material[:, kept][row],
            mask=self.mask[:, kept][row],
            obstacle=self.obstacle[row],
            obstacle_mask=self.obstacle_mask[row],
            gravity=self.gravity[row],
            fields={
                name: values[:, :, kept][row] if values.shape[1] == 1 else values[:, :, kept][row[:, None], frame]
                for name, values in self.fields.items()
            },
        )


def collate(recordings: Sequence[Recording], scene: Scene, length: int | None = None) -> Window:
    """Makes one batch of the first `length` frames of B recordings; of all frames, equally many, when None.

    Returns:
        Window: padded to the largest recording.
    """
    frames = len(recordings[0].frames) if length is None else length
    return PaddedRecordings.stack(recordings, scene).gather(range(len(recordings)), [0] * len(recordings), frames)


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


def _index_tensor(values: Sequence[int], device: torch.device) -> Tensor:
    """Indices on a device; the copy to a GPU does not wait for the kernels that are queued there."""
    index = torch.as_tensor(values)
    return index.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else index.to(device)


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
