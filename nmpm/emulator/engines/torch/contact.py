"""Contact: particles do not enter obstacles, however fast they are and whatever the network predicts.

An obstacle is where the solid fraction of the grid, interpolated linearly, exceeds `SURFACE`. A path stops before it
gets deeper than that, and goes on straight along the surface as far as it can; particles that an obstacle has moved
over are pushed out. Positions that are NaN stay so: nothing hides them from later checks. Frames are sampled in pieces
of at most half a cell, so that nothing jumps over a wall of one cell; steps and slides of more than 32 cells fall into
longer pieces, which bounds time and memory.

On a CPU only particles that touch an obstacle are treated, in as many pieces as the fastest needs. Elsewhere branching
on values would halt the device: all particles are treated, in the largest number of pieces, with masks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional

from nmpm.grid import Grid
from nmpm.transfer.execution import chunks, is_eager_cpu
from nmpm.transfer.linear import linear_g2p, linear_stencil

SURFACE = 0.4
"""Solid fraction at an obstacle's surface: walls of one cell reach 0.5 at least, wherever they lie between nodes."""

_PIECE = 0.5  # cells
_MAX_PIECES = 64
_EVEN = 1e-5  # solid fraction per cell: smaller slopes are rounding, and point anywhere
_WAYS_OUT = 4  # places that are tried to get out of an obstacle, `_PIECE` cells from one to the next

Depth = Callable[[Tensor], Tensor]
"""Solid fraction (n, K) at places (n, K, D): each particle's places in its own scene."""


def obstacle_share(solid: Tensor, walls: Tensor) -> Tensor:
    """The share of each cell without its wall that is obstacle, (B, 1, *S) in [0, 1].

    From the shares of the whole cell that are wall or obstacle, (B, 1, *S), and wall, (*S).
    """
    free = 1 - walls
    return torch.where(free > 0, (solid - walls) / free.clamp(min=1e-6), 0.0).clamp(0, 1)


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
        return self.hold_touching(start, path, mask) if is_eager_cpu(start) else self.hold_all(start, path, mask)

    def inside(self, places: Tensor) -> Tensor:
        """(B, K) bool: whether places (B, K, D) in cells are deeper in an obstacle than its surface."""
        return self._scene_depth(places) > SURFACE

    def hold_touching(self, start: Tensor, path: Tensor, mask: Tensor | None = None) -> Tensor:
        """`hold` for a CPU: treats the particles that touch, and returns the same tensor if there are none."""
        steps = path.diff(dim=1, prepend=start.unsqueeze(1))
        pieces = _pieces(_longest_steps(steps, mask))
        inside = self.inside(start)
        touching = inside.clone()
        for piece in range(int(pieces.max())):
            share = (piece / pieces).clamp(max=1).view(-1, 1, 1, 1)
            places = (path - steps * share).flatten(1, 2)
            touching |= (self._scene_depth(places).unflatten(1, path.shape[1:3]) > SURFACE).any(1)
        touching = touching if mask is None else touching & mask
        if not bool(touching.any()):
            return path
        scene, particle = touching.nonzero().unbind(1)
        depth, count = partial(self._depth, scene), pieces[scene]
        mine, begin, stuck = path[scene, :, particle], start[scene, particle], inside[scene, particle]
        touch = _touch(depth, begin, mine, count, int(pieces.max()))
        longest = path.new_zeros(len(path)).scatter_reduce(0, scene, _length(touch.along), "amax")
        finer = _pieces(longest.unsqueeze(1))[scene]
        held = _slid(depth, mine, touch, count, finer, int(finer.max()))
        if bool(stuck.any()):
            out = _pushed_out(partial(self._depth, scene[stuck]), begin[stuck], path.shape[1])
            held[stuck] = torch.where(mine[stuck].isnan(), mine[stuck], out)
        path = path.clone()
        path[scene, :, particle] = held
        return path

    def hold_all(self, start: Tensor, path: Tensor, mask: Tensor | None = None) -> Tensor:
        """`hold` without reading values back: treats all particles, in chunks that bound the memory."""
        batch, frames, count, _ = path.shape
        if not count:
            return path
        pieces = _pieces(_longest_steps(path.diff(dim=1, prepend=start.unsqueeze(1)), mask))
        parts = chunks(count, path.device, values=batch * frames * _MAX_PIECES)
        touches, rows = [], []
        for part in parts:
            begin, mine = start[:, part].flatten(0, 1), path[:, :, part].transpose(1, 2).flatten(0, 1)
            counts = _spread(pieces, len(begin))
            touch = _touch(self._depth_of_all, begin, mine, counts, _MAX_PIECES)
            inside = (self._depth_of_all(begin.unsqueeze(1)) > SURFACE).squeeze(1)
            if mask is not None:
                real = mask[:, part].flatten()
                inside, touch = inside & real, dataclasses.replace(touch, hits=touch.hits & real)
            rows.append((begin, mine, counts, inside))
            touches.append(touch)
        lengths = [
            torch.where(inside | touch.hits, _length(touch.along), 0.0).view(batch, -1).amax(1, keepdim=True)
            for (*_, inside), touch in zip(rows, touches, strict=True)
        ]
        finer = _pieces(torch.cat(lengths, dim=1))
        paths = []
        for (begin, mine, counts, inside), touch in zip(rows, touches, strict=True):
            held = _slid(self._depth_of_all, mine, touch, counts, _spread(finer, len(begin)), _MAX_PIECES)
            out = _pushed_out(self._depth_of_all, begin, frames)
            held = torch.where(touch.hits[:, None, None], held, mine)
            held = torch.where(inside[:, None, None] & ~mine.isnan(), out, held)
            paths.append(held.unflatten(0, (batch, -1)).transpose(1, 2))
        return torch.cat(paths, dim=2)

    def _scene_depth(self, places: Tensor) -> Tensor:
        """(B, K): solid fraction at places (B, K, D)."""
        return linear_g2p(self.solid.to(places.dtype), places, self.grid).squeeze(-1)

    def _depth_of_all(self, places: Tensor) -> Tensor:
        """(n, K): solid fraction at places (n, K, D) of as many particles of each scene, one scene after the other."""
        scenes = places.reshape(len(self.solid), -1, places.shape[-1])
        return self._scene_depth(scenes).reshape(places.shape[:2])

    def _depth(self, scene: Tensor, places: Tensor) -> Tensor:
        """(n, K): solid fraction at places (n, K, D) of scenes (n,)."""
        stencil = linear_stencil(places, self.grid)
        values = self.solid.flatten(1)[scene[:, None, None], stencil.node]
        return (values * stencil.weight).sum(-1)


@dataclass(frozen=True)
class _Touch:
    """Where n particles first get too deep into an obstacle in a bundle, if they do.

    Args:
        hits: (n,) bool, whether they do.
        free: (n,) pieces before that, counted over the frames; all of them for particles that keep clear.
        place: (n, D) the last place that is not too deep.
        along: (n, D) the rest of the way from there, without its part into the solid.
    """

    hits: Tensor
    free: Tensor
    place: Tensor
    along: Tensor


def _touch(depth: Depth, start: Tensor, path: Tensor, pieces: Tensor, most: int) -> _Touch:
    """Follow paths (n, m, D) from start (n, D), each frame in pieces (n,), of which there are `most` at most."""
    frames = path.shape[1]
    before = torch.cat([start.unsqueeze(1), path[:, :-1]], dim=1)
    order = torch.arange(most, device=path.device)
    share = ((order + 1) / pieces.unsqueeze(1)).clamp(max=1)
    points = (before.unsqueeze(2) + (path - before).unsqueeze(2) * share[:, None, :, None]).flatten(1, 2)
    counts = (order < pieces.unsqueeze(1)).repeat(1, frames)
    first = _first(counts & ~(depth(points) <= SURFACE))
    row = torch.arange(len(start), device=path.device)
    place = torch.where((first > 0).unsqueeze(-1), points[row, first - 1], start)
    rest = path[:, -1] - place
    inward = _inward(depth, points[row, first.clamp(max=frames * most - 1)])
    along = rest - (rest * inward).sum(-1, keepdim=True).clamp(min=0) * inward
    free = first.div(most, rounding_mode="floor") * pieces + first.remainder(most)
    return _Touch(first < frames * most, free, place, along)


def _slid(depth: Depth, path: Tensor, touch: _Touch, pieces: Tensor, finer: Tensor, most: int) -> Tensor:
    """(n, m, D): paths up to where they touch, and along the surface from there.

    What is left of the way at the touch loses its part into the solid, and is gone straight, evenly over the frames
    left, until the surface bends into it: looked at in `finer` (n,) pieces, `most` at most.
    """
    frames = path.shape[1]
    order = torch.arange(most, device=path.device)
    ahead = ((order + 1) / finer.unsqueeze(1)).clamp(max=1)
    blocked = ~(depth(touch.place.unsqueeze(1) + touch.along.unsqueeze(1) * ahead.unsqueeze(-1)) <= SURFACE)
    share = torch.minimum(_first(blocked), finer) / finer
    passed = torch.arange(1, frames + 1, device=path.device) * pieces.unsqueeze(1) - touch.free.unsqueeze(1)
    time = passed / (frames * pieces - touch.free).clamp(min=1).unsqueeze(1)
    gone = torch.minimum(time, share.unsqueeze(1)).unsqueeze(-1)
    onward = touch.place.unsqueeze(1) + touch.along.unsqueeze(1) * gone
    return torch.where((passed <= 0).unsqueeze(-1), path, onward)


def _pushed_out(depth: Depth, start: Tensor, frames: int) -> Tensor:
    """(n, m, D): paths straight out of the obstacle, as far as needed or to where it is least deep."""
    ways = _PIECE * torch.arange(_WAYS_OUT + 1, device=start.device, dtype=start.dtype)
    places = start.unsqueeze(1) - _inward(depth, start).unsqueeze(1) * ways[:, None]
    deep = depth(places)
    out = deep <= SURFACE
    best = torch.where(out.any(1), _first(out), deep.argmin(1))
    way = places[torch.arange(len(start), device=start.device), best] - start
    shares = torch.arange(1, frames + 1, device=start.device, dtype=start.dtype) / frames
    return start.unsqueeze(1) + way.unsqueeze(1) * shares[:, None]


def _inward(depth: Depth, places: Tensor) -> Tensor:
    """(n, D): unit vectors at places (n, D) along which the solid gets deeper; zero where it is even."""
    half = 0.5 * torch.eye(places.shape[-1], device=places.device, dtype=places.dtype)
    ends = torch.cat([places.unsqueeze(1) + half, places.unsqueeze(1) - half], dim=1)
    ahead, behind = depth(ends).chunk(2, dim=1)
    slope = ahead - behind
    even = (slope.abs() < _EVEN).all(-1, keepdim=True)
    return torch.where(even, 0.0, functional.normalize(slope, dim=-1))


def _length(steps: Tensor) -> Tensor:
    """(...) lengths of steps (..., D), without gradient; 0 for those that are not finite, as they have no pieces."""
    lengths: Tensor = steps.detach().norm(dim=-1)
    return lengths.nan_to_num(0.0, 0.0, 0.0)


def _longest_steps(steps: Tensor, mask: Tensor | None) -> Tensor:
    """(B, N): length of each particle's longest step (B, m, N, D); 0 for padding."""
    lengths = _length(steps).amax(1)
    return lengths if mask is None else lengths.masked_fill(~mask, 0.0)


def _pieces(lengths: Tensor) -> Tensor:
    """(B,): pieces of at most half a cell in the longest of each scene's lengths (B, N), `_MAX_PIECES` at most."""
    if not lengths.shape[1]:
        return lengths.new_ones(len(lengths))
    return (lengths.amax(1) / _PIECE).ceil().clamp(1, _MAX_PIECES)


def _spread(values: Tensor, count: int) -> Tensor:
    """(n,): values (B,) repeated for the n / B rows of each scene."""
    return values.unsqueeze(1).expand(-1, count // len(values)).flatten()


def _first(marks: Tensor) -> Tensor:
    """(n,): index of the first True in each row (n, K), K where there is none. Deterministic on every device."""
    size = marks.shape[1]
    order = torch.arange(size, device=marks.device)
    return torch.where(marks, order, size).amin(1)
