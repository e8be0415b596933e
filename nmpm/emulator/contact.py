"""Contact: particles do not get into obstacles, however fast they are and whatever the network says.

An obstacle is where the solid fraction of the grid, interpolated linearly, exceeds `SURFACE`. A path stops before it
gets deeper than that, and goes on straight along the surface as far as it can; what an obstacle has moved over is
pushed out. Paths are looked at in pieces of at most half a cell, so that nobody jumps over a wall of one cell. Only
steps of more than 32 cells, and slides of more in a bundle, fall into longer ones, lest one runaway costs all memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nmpm.grid import Grid
from nmpm.transfer.linear import linear_g2p, linear_stencil

SURFACE = 0.4
"""Solid fraction at an obstacle's surface: walls of one cell reach 0.5 at least, wherever they lie between nodes."""

_PIECE = 0.5  # cells
_MOST_PIECES = 64
_WAYS_OUT = (0.5, 1.0, 1.5, 2.0)  # cells: the first that leads out of an obstacle is taken


@dataclass(frozen=True)
class Contact:
    """The obstacles of B scenes.

    Args:
        solid: (B, 1, *S) solid fraction.
        grid: The grid.
    """

    solid: Tensor
    grid: Grid

    def hold(self, start: Tensor, path: Tensor) -> Tensor:
        """A path that does not lead into an obstacle; one that starts in an obstacle leads out.

        Args:
            start: (B, N, D) in cells.
            path: (B, m, N, D) as predicted.

        Returns:
            (B, m, N, D): the path itself for particles that keep clear of obstacles.
        """
        steps = path.diff(dim=1, prepend=start.unsqueeze(1))
        pieces = _pieces(steps)
        inside = self._depths(start) > SURFACE
        touching = inside.clone()
        for piece in range(pieces):
            places = (path - steps * (piece / pieces)).flatten(1, 2)
            touching |= (self._depths(places).unflatten(1, path.shape[1:3]) > SURFACE).any(1)
        if not touching.any():
            return path
        scene, particle = touching.nonzero().unbind(1)
        mine, begin = path[scene, :, particle], start[scene, particle]
        held, stuck = self._slid(scene, begin, mine, pieces), inside[scene, particle]
        if stuck.any():
            held = held.clone()
            held[stuck] = self._pushed_out(scene[stuck], begin[stuck], path.shape[1])
        path = path.clone()
        path[scene, :, particle] = held
        return path

    def _slid(self, scene: Tensor, start: Tensor, path: Tensor, pieces: int) -> Tensor:
        """(n, m, D): paths of particles of scenes (n,) up to where they touch, and along the surface from there.

        What is left of the way at the touch loses its part into the solid, and is gone straight, evenly over the frames
        left, until the surface bends into it.
        """
        count, frames, _ = path.shape
        before = torch.cat([start.unsqueeze(1), path[:, :-1]], dim=1)
        shares = torch.arange(1, pieces + 1, device=path.device, dtype=path.dtype) / pieces
        points = (before.unsqueeze(2) + (path - before).unsqueeze(2) * shares[:, None]).flatten(1, 2)
        free = (self._depth(scene, points) <= SURFACE).cumprod(1).sum(1)  # pieces before the first that is too deep
        row = torch.arange(count, device=path.device)
        touch = torch.where((free > 0).unsqueeze(-1), points[row, free - 1], start)
        blocked = points[row, free.clamp(max=points.shape[1] - 1)]
        rest = path[:, -1] - touch
        inward = self._inward(scene, blocked)
        along = rest - (rest * inward).sum(-1, keepdim=True).clamp(min=0) * inward
        finer = _pieces(along)
        ahead = torch.arange(1, finer + 1, device=path.device, dtype=path.dtype) / finer
        depth = self._depth(scene, touch.unsqueeze(1) + along.unsqueeze(1) * ahead[:, None])
        share = (depth <= SURFACE).cumprod(1).sum(1) / finer
        passed = torch.arange(1, frames + 1, device=path.device) * pieces - free.unsqueeze(1)
        time = passed / (frames * pieces - free).clamp(min=1).unsqueeze(1)
        onward = touch.unsqueeze(1) + along.unsqueeze(1) * torch.minimum(time, share.unsqueeze(1)).unsqueeze(-1)
        return torch.where((passed <= 0).unsqueeze(-1), path, onward)

    def _pushed_out(self, scene: Tensor, start: Tensor, frames: int) -> Tensor:
        """(n, m, D): straight out of the obstacle, as far as needed or to where it is least deep."""
        ways = torch.tensor((0.0, *_WAYS_OUT), device=start.device, dtype=start.dtype)
        places = start.unsqueeze(1) - self._inward(scene, start).unsqueeze(1) * ways[:, None]
        depth = self._depth(scene, places)
        out = (depth <= SURFACE).int()
        best = torch.where(out.any(1), out.argmax(1), depth.argmin(1))
        way = places[torch.arange(len(start), device=start.device), best] - start
        shares = torch.arange(1, frames + 1, device=start.device, dtype=start.dtype) / frames
        return start.unsqueeze(1) + way.unsqueeze(1) * shares[:, None]

    def _depths(self, places: Tensor) -> Tensor:
        """(B, K): solid fraction at places (B, K, D)."""
        return linear_g2p(self.solid.to(places.dtype), places, self.grid).squeeze(-1)

    def _depth(self, scene: Tensor, places: Tensor) -> Tensor:
        """(n, K): solid fraction at places (n, K, D) of scenes (n,)."""
        stencil = linear_stencil(places, self.grid)
        values = self.solid.flatten(1)[scene[:, None, None], stencil.node]
        return (values * stencil.weight).sum(-1)

    def _inward(self, scene: Tensor, places: Tensor) -> Tensor:
        """(n, D): unit vectors at places (n, D) along which the solid gets deeper; zero where it is even."""
        half = 0.5 * torch.eye(places.shape[-1], device=places.device, dtype=places.dtype)
        ends = torch.cat([places.unsqueeze(1) + half, places.unsqueeze(1) - half], dim=1)
        ahead, behind = self._depth(scene, ends).chunk(2, dim=1)
        return functional.normalize(ahead - behind, dim=-1)


def _pieces(steps: Tensor) -> int:
    """Into how many pieces of at most half a cell the longest of steps (..., D) falls; `_MOST_PIECES` at most."""
    longest = float(steps.detach().norm(dim=-1).max()) if steps.numel() else 0.0
    return min(_MOST_PIECES, max(1, math.ceil(longest / _PIECE)))
