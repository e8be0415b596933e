"""Recordings stacked into one padded tensor, from which windows are gathered in one indexing operation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nmpm.data.loading.recording import Recording
from nmpm.particles import Window
from nmpm.scene import Scene


@dataclass(frozen=True)
class PaddedRecordings:
    """S recordings of a scene, padded to the longest and largest; padding particles are at the domain's centre.

    Args:
        frames: (S, T, N, D) positions, in domain length.
        material, mask, obstacle, obstacle_mask, gravity: as in `Window`, with S in place of B.
        scene: The recordings' scene.
    """

    frames: Tensor
    material: Tensor
    mask: Tensor
    obstacle: Tensor
    obstacle_mask: Tensor
    gravity: Tensor
    scene: Scene

    @classmethod
    def stack(cls, recordings: Sequence[Recording], scene: Scene) -> PaddedRecordings:
        """Copies recordings into padded tensors."""
        centre = [(low + high) / 2 for low, high in scene.domain]
        frames, mask = _pad_and_stack([recording.frames for recording in recordings], centre)
        obstacle, obstacle_mask = _pad_and_stack([recording.obstacle[None] for recording in recordings], centre)
        material, _ = _pad_and_stack([recording.material[None, :, None] for recording in recordings], [0])
        gravity = torch.stack([recording.gravity for recording in recordings])
        return cls(frames, material[:, 0, :, 0], mask, obstacle[:, 0], obstacle_mask, gravity, scene)

    def recording(self, row: int, original: Recording) -> Recording:
        """A view of one row without its padding; `original` is the recording that was stacked there."""
        frames, count, _ = original.frames.shape
        return Recording(
            frames=self.frames[row, :frames, :count],
            material=self.material[row, :count],
            obstacle=self.obstacle[row, : len(original.obstacle)],
            gravity=self.gravity[row],
        )

    def to(self, device: torch.device) -> PaddedRecordings:
        """Copies the tensors to a device; tensors that are there already are shared."""
        return PaddedRecordings(
            frames=self.frames.to(device),
            material=self.material.to(device),
            mask=self.mask.to(device),
            obstacle=self.obstacle.to(device),
            obstacle_mask=self.obstacle_mask.to(device),
            gravity=self.gravity.to(device),
            scene=self.scene,
        )

    def gather(self, rows: Sequence[int], starts: Sequence[int], length: int) -> Window:
        """Gathers consecutive frames of B recordings.

        Args:
            rows: Rows of the recordings.
            starts: First frame of each. On the scene's periodic axes positions are unwrapped from there on, so that
                differences between frames are displacements.
            length: Frames of the window; each recording must have as many from its start on.
        """
        row = _index_tensor(rows, self.frames.device)
        first = _index_tensor(starts, self.frames.device)
        frame = first[:, None] + torch.arange(length, device=self.frames.device)
        frames = self.frames[row[:, None], frame]
        unwrap(frames, self.scene)
        return Window(
            frames=frames,
            material=self.material[row],
            mask=self.mask[row],
            obstacle=self.obstacle[row],
            obstacle_mask=self.obstacle_mask[row],
            gravity=self.gravity[row],
        )


def collate(recordings: Sequence[Recording], scene: Scene, length: int | None = None) -> Window:
    """Makes one batch of the first `length` frames of B recordings; of all frames, equally many, when None.

    Returns:
        Window: padded to the largest recording.
    """
    frames = len(recordings[0].frames) if length is None else length
    return PaddedRecordings.stack(recordings, scene).gather(range(len(recordings)), [0] * len(recordings), frames)


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
