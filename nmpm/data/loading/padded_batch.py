"""SplitRecordings side by side in one padded tensor, from which windows are gathered in one go."""

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
    """S recordings of a scene, padded to the longest and largest; padding particles lie at the domain's centre.

    Args:
        frames: (S, T, N, D) positions, in domain length.
        material, mask, obstacle, obstacle_mask, gravity: as in `Window`, with S in place of B.
        scene: What they are recordings of.
    """

    frames: Tensor
    material: Tensor
    mask: Tensor
    obstacle: Tensor
    obstacle_mask: Tensor
    gravity: Tensor
    scene: Scene

    @classmethod
    def of(cls, recordings: Sequence[Recording], scene: Scene) -> PaddedRecordings:
        """Puts recordings on a padded, copying them."""
        centre = [(low + high) / 2 for low, high in scene.domain]
        frames, mask = _pad_and_stack([recording.frames for recording in recordings], centre)
        obstacle, obstacle_mask = _pad_and_stack([recording.obstacle[None] for recording in recordings], centre)
        material, _ = _pad_and_stack([recording.material[None, :, None] for recording in recordings], [0])
        gravity = torch.stack([recording.gravity for recording in recordings])
        return cls(frames, material[:, 0, :, 0], mask, obstacle[:, 0], obstacle_mask, gravity, scene)

    def recording(self, row: int, like: Recording) -> Recording:
        """A view of the recording in a row, without the padding that `like`, a recording of the same sizes, lacks."""
        frames, count, _ = like.frames.shape
        return Recording(
            frames=self.frames[row, :frames, :count],
            material=self.material[row, :count],
            obstacle=self.obstacle[row, : len(like.obstacle)],
            gravity=self.gravity[row],
        )

    def to(self, device: torch.device) -> PaddedRecordings:
        """The same on another device."""
        return PaddedRecordings(
            frames=self.frames.to(device),
            material=self.material.to(device),
            mask=self.mask.to(device),
            obstacle=self.obstacle.to(device),
            obstacle_mask=self.obstacle_mask.to(device),
            gravity=self.gravity.to(device),
            scene=self.scene,
        )

    def window(self, rows: Sequence[int], starts: Sequence[int], length: int) -> Window:
        """Consecutive frames of B recordings.

        Args:
            rows: Which recordings.
            starts: First frame of each; on the scene's periodic axes positions follow the particle across the border
                from there, so that differences between frames are displacements.
            length: Frames, at most what the shortest of them has from its start on.
        """
        device = self.frames.device
        row = torch.as_tensor(rows, device=device)
        frame = torch.as_tensor(starts, device=device)[:, None] + torch.arange(length, device=device)
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
    """The first `length` frames of B recordings as one batch; all frames, of which they have equally many, when None.

    Returns:
        Window: padded to the largest recording.
    """
    frames = len(recordings[0].frames) if length is None else length
    return PaddedRecordings.stack(recordings, scene).window(range(len(recordings)), [0] * len(recordings), frames)


def unwrap(frames: Tensor, scene: Scene) -> None:
    """Undoes, in place, the jumps of (B, T, N, D) positions across periodic borders, by minimum image.

    The first frame stays where it is; a later one may lie outside the domain, by whole periods.
    """
    for axis, (low, high) in enumerate(scene.domain):
        if scene.periodic[axis]:
            period = high - low
            along = frames[..., axis]
            turns = torch.round(along.diff(dim=1) / period).cumsum(dim=1)
            along[:, 1:] -= turns * period


def _pad_and_stack(parts: Sequence[Tensor], filler: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Stacks (T_i, N_i, C) tensors to (S, T, N, C), with (S, N) telling which of the N are not filler."""
    counts = [part.shape[1] for part in parts]
    longest = max(part.shape[0] for part in parts)
    # NumPy copies in this thread alone; PyTorch would wait for its thread pool, which training needs.
    padded = np.empty((len(parts), longest, max(counts), len(filler)), dtype=parts[0].numpy().dtype)
    padded[:] = filler
    for row, (part, count) in enumerate(zip(parts, counts, strict=True)):
        padded[row, : part.shape[0], :count] = part.numpy()
    mask = np.arange(max(counts)) < np.asarray(counts)[:, None]
    return torch.from_numpy(padded), torch.from_numpy(mask)
