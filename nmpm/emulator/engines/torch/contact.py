"""Contact: particles do not enter obstacles, however fast they are and whatever the network predicts.

An obstacle is where the solid fraction of the grid, interpolated linearly, exceeds `SURFACE`. A path stops before it
gets deeper than that, and goes on straight along the surface as far as it can; particles that an obstacle has moved
over are pushed out. Positions that are NaN stay so: nothing hides them from later checks. Frames are looked at in
pieces of at most half a cell, as many as the fastest particle of a scene needs, so that nothing jumps over a wall of
one cell; steps and slides of more than 32 cells fall into longer pieces, which bounds time and memory.

All particles are treated, with masks: branching on values would halt a GPU. On a CPU two values are read: how many
pieces any scene needs, elsewhere the largest number, and whether any particle touches.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nmpm.grid import Grid
from nmpm.transfer import chunks, is_eager_cpu, linear_g2p

SURFACE = 0.4
"""Solid fraction at an obstacle's surface: walls of one cell reach 0.5 at least, wherever they lie between nodes."""

_PIECE = 0.5  # cells
_MAX_PIECES = 64
_EVEN = 1e-5  # solid fraction per cell: smaller slopes are rounding, and point anywhere
_WAYS_OUT = 4  # places that are tried to get out of an obstacle, `_PIECE` cells from one to the next


def obstacle_share(solid: Tensor, walls: Tensor) -> Tensor:
    """The share of each cell without its wall that is obstacle, (B, 1, *S) in [0, 1].

    From the shares of the whole cell that are wall or obstacle, (B, 1, *S), and wall, (*S).
    """
    return ((solid - walls) / (1 - walls).clamp(min=1e-6)).clamp(0, 1)


@dataclass(frozen=True)
class Contact:
    """The obstacles of B scenes.

    Args:
        solid: (B, 1, *S) solid fraction.
        grid: The grid.
    """

    solid: Tensor
    grid: Grid

    def hold(self, start: Tensor, path: Tensor, mask: Tensor | None = None) -> Tensor:
        """A path (B, m, N, D) that does not lead into an obstacle; one that starts in an obstacle leads out.

        From `start` (B, N, D) and the predicted path. Padding, False in `mask` (B, N), stays and changes no other path.
        """
        if not path.shape[2]:
            return path
        real = start.new_ones(start.shape[:2], dtype=torch.bool) if mask is None else mask
        inside = self.inside(start) & real
        before = torch.cat([start.unsqueeze(1), path[:, :-1]], dim=1)
        steps = path - before
        pieces = _pieces(_length(steps).amax(1) * real)
        free = self._free_pieces(before.flatten(1, 2), steps.flatten(1, 2), pieces).view(path.shape[:3])
        free = torch.where(real.unsqueeze(1), free, pieces.unsqueeze(1))
        if is_eager_cpu(path) and not bool(inside.any() | (free < pieces.unsqueeze(1)).any()):
            return path
        held = self._slid(before, steps, path, pieces, free)
        return torch.where(inside[:, None, :, None] & ~path.isnan(), self._pushed_out(start, path.shape[1]), held)

    def inside(self, places: Tensor) -> Tensor:
        """(B, K) bool: whether places (B, K, D) in cells are deeper in an obstacle than its surface."""
        return self._depth(places) > SURFACE

    def _depth(self, places: Tensor) -> Tensor:
        """(B, K): solid fraction at places (B, K, D)."""
        return linear_g2p(self.solid.to(places.dtype), places, self.grid).squeeze(-1)

    @torch.no_grad()
    def _free_pieces(self, start: Tensor, way: Tensor, pieces: Tensor) -> Tensor:
        """(B, K): how many pieces of ways (B, K, D) from start (B, K, D) end before the first that ends too deep.

        All of `pieces` (B, 1) where none does.
        """
        most = int(pieces.max()) if is_eager_cpu(pieces) else _MAX_PIECES
        order = torch.arange(most, device=start.device, dtype=start.dtype)
        share = ((order + 1) / pieces).view(-1, 1, most, 1)
        free = []
        for part in chunks(start.shape[1], start.device, values=start.shape[0] * most):
            ends = torch.addcmul(start[:, part].unsqueeze(2), way[:, part].unsqueeze(2), share)
            clear = self._depth(ends.flatten(1, 2)).unflatten(1, (-1, most)) <= SURFACE
            free.append(torch.add(order, clear, alpha=most).amin(-1))  # pieces beyond the way's end come last
        return torch.minimum(torch.cat(free, dim=1), pieces)

    def _slid(self, before: Tensor, steps: Tensor, path: Tensor, pieces: Tensor, free: Tensor) -> Tensor:
        """(B, m, N, D): paths up to where they touch, and along the surface from there.

        What is left of the way at the touch loses its part into the solid, and is gone straight, evenly over the frames
        left, until the surface bends into it, looked at in finer pieces. Of positions before each frame, the frames'
        steps, and the path (B, m, N, D); and of the `pieces` (B, 1) of each frame the first `free` (B, m, N) are clear.
        """
        frames = path.shape[1]
        order = torch.arange(frames, device=path.device).view(-1, 1)
        touching = torch.add(order, free == pieces.unsqueeze(1), alpha=frames).amin(1, keepdim=True)
        frame = touching.clamp(max=frames - 1)  # (B, 1, N): the one that touches first, or the last
        gone = free.gather(1, frame).squeeze(1)
        begin, step = (_at(values, frame) for values in (before, steps))
        place = begin + step * (gone / pieces).unsqueeze(-1)
        inward = self._inward(begin + step * ((gone + 1) / pieces).unsqueeze(-1))
        rest = path[:, -1] - place
        along = rest - (rest * inward).sum(-1, keepdim=True).clamp(min=0) * inward
        finer = _pieces(_length(along) * (touching < frames).squeeze(1))
        share = self._free_pieces(place, along, finer) / finer
        gone = torch.addcmul(gone, frame.squeeze(1), pieces)  # now since the bundle's start
        passed = (order + 1) * pieces.unsqueeze(1) - gone.unsqueeze(1)
        time = passed / (frames * pieces - gone).clamp(min=1).unsqueeze(1)
        onward = torch.minimum(time, share.unsqueeze(1)).unsqueeze(-1) * along.unsqueeze(1) + place.unsqueeze(1)
        return torch.where(passed.unsqueeze(-1) > 0, onward, path)

    def _pushed_out(self, start: Tensor, frames: int) -> Tensor:
        """(B, m, N, D): paths straight out of the obstacle, as far as needed or to where it is least deep."""
        order = torch.arange(_WAYS_OUT + 1, device=start.device, dtype=start.dtype)
        way = -_PIECE * self._inward(start)
        places = start.unsqueeze(2) + way.unsqueeze(2) * order.unsqueeze(-1)
        depth = self._depth(places.flatten(1, 2)).unflatten(1, (-1, _WAYS_OUT + 1))
        best = torch.where(depth <= SURFACE, order - len(order), depth).argmin(-1, keepdim=True)
        share = torch.arange(1, frames + 1, device=start.device, dtype=start.dtype).view(-1, 1, 1) / frames
        return start.unsqueeze(1) + share * (best * way).unsqueeze(1)

    def _inward(self, places: Tensor) -> Tensor:
        """(B, N, D): unit vectors at places (B, N, D) along which the solid gets deeper; zero where it is even."""
        half = 0.5 * torch.eye(places.shape[-1], device=places.device, dtype=places.dtype)
        ends = places.unsqueeze(2) + torch.stack([half, -half], dim=1).flatten(0, 1)
        ahead, behind = self._depth(ends.flatten(1, 2)).unflatten(1, (-1, len(half), 2)).unbind(-1)
        slope = ahead - behind
        inward: Tensor = functional.normalize(slope, dim=-1) * (slope.abs().amax(-1, keepdim=True) >= _EVEN)
        return inward


def _at(values: Tensor, frame: Tensor) -> Tensor:
    """(B, N, D): values (B, m, N, D) of each particle's frame (B, 1, N)."""
    index = frame.unsqueeze(-1).expand(-1, -1, -1, values.shape[-1])
    picked: Tensor = values.gather(1, index).squeeze(1)
    return picked


def _length(steps: Tensor) -> Tensor:
    """(...) lengths of steps (..., D), without gradient; 0 for those that are not finite, as they have no pieces."""
    lengths: Tensor = steps.detach().norm(dim=-1)
    return lengths.nan_to_num(0.0, 0.0, 0.0)


def _pieces(lengths: Tensor) -> Tensor:
    """(B, 1): pieces of at most half a cell in the longest of each scene's lengths (B, N), `_MAX_PIECES` at most."""
    return (lengths.amax(1, keepdim=True) / _PIECE).ceil().clamp(1, _MAX_PIECES)
