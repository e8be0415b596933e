"""Axial attention: each patch of cells attends to all patches along each axis in turn, and so sees the whole domain.

Sources: Ho et al., Axial Attention in Multidimensional Transformers, 2019; rotary places: Su et al., RoFormer, 2021.
Places are relative, so that a wider domain is only more patches; along a periodic axis they are whole turns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor, full_precision
from nmpm.processors.convolution import (
    CONVOLUTIONS,
    TRANSPOSED,
    Convolution,
    check_multiple,
    crop,
    embed_patches,
    pad_to_multiple,
    return_patches,
)
from nmpm.processors.unet import ChannelNorm

_SLOWEST = 100.0  # patches in which the slowest rotary angle turns by one radian


@dataclass(frozen=True)
class Axial(Processor):
    """Recipe of an axial transformer.

    Args:
        width: Channels of a patch.
        layers: Number of layers; each attends along every axis.
        heads: Number of heads; width over heads must be even.
        patch: Cells of a patch along each axis.
        expansion: Width of the perceptrons over that of a patch.
    """

    width: int = 128
    layers: int = 3
    heads: int = 4
    patch: int = 4
    expansion: int = 2

    def build(self, layout: GridLayout) -> GridProcessor:
        least = min(self.width, self.layers, self.heads, self.patch, self.expansion)
        if least < 1 or self.width % (2 * self.heads):
            raise ConfigError(f"Axial needs positive numbers and a width that is a multiple of 2 x heads; got {self}.")
        return AxialNetwork(self, layout)

    def check_grid(self, grid: Grid) -> None:
        check_multiple(grid, self.patch, f"patches of {self.patch} cells")


class AxialNetwork(GridProcessor):
    """Patches, layers, patches back to cells, joined by a convolution with the cells themselves for what is fine."""

    channel_layers = ChannelLayers("cells.convolution", "last")

    def __init__(self, recipe: Axial, layout: GridLayout) -> None:
        super().__init__()
        dim, width, outputs = layout.dim, recipe.width, layout.frames * layout.out_channels
        self.patch, self.frames = recipe.patch, layout.frames
        fine = max(1, width // 4)
        self.cells = Convolution(layout.in_channels, fine, 3, layout.periodic)
        self.embed = CONVOLUTIONS[dim](fine, width, recipe.patch, recipe.patch)
        self.layers = nn.ModuleList(AxialLayer(recipe, layout.periodic) for _ in range(recipe.layers))
        self.back = TRANSPOSED[dim](width, fine, recipe.patch, recipe.patch)
        self.join = Convolution(2 * fine, fine, 3, layout.periodic)
        self.last = CONVOLUTIONS[dim](fine, outputs, 1)

    def forward(self, grid: Tensor) -> Tensor:
        shape = grid.shape[2:]
        cells = functional.silu(self.cells(pad_to_multiple(grid, self.patch)))
        hidden = embed_patches(self.embed, cells, self.patch)
        for layer in self.layers:
            hidden = layer(hidden)
        joined = functional.silu(self.join(torch.cat([cells, return_patches(self.back, hidden, self.patch)], dim=1)))
        out: Tensor = crop(self.last(joined), shape).unflatten(1, (self.frames, -1))
        return out


class AxialLayer(nn.Module):
    """Attention along each axis, then a perceptron at each patch."""

    def __init__(self, recipe: Axial, periodic: tuple[bool, ...]) -> None:
        super().__init__()
        width, dim, wide = recipe.width, len(periodic), recipe.width * recipe.expansion
        kind = CONVOLUTIONS[dim]
        self.attentions = nn.ModuleList(
            Attention(width, recipe.heads, axis, wraps) for axis, wraps in enumerate(periodic)
        )
        self.norms = nn.ModuleList(ChannelNorm(width, dim) for _ in range(dim + 1))
        self.perceptron = nn.Sequential(kind(width, wide, 1), nn.SiLU(), kind(wide, width, 1))

    def forward(self, hidden: Tensor) -> Tensor:
        *before, last = self.norms
        for norm, attention in zip(before, self.attentions, strict=True):
            hidden = hidden + attention(norm(hidden))
        change: Tensor = self.perceptron(last(hidden))
        return hidden + change


class Attention(nn.Module):
    """Each patch attends to all those of its row along one axis."""

    def __init__(self, width: int, heads: int, axis: int, wraps: bool) -> None:
        super().__init__()
        self.heads, self.axis, self.wraps = heads, axis + 2, wraps
        self.project = nn.Linear(width, 3 * width, bias=False)
        self.out = nn.Linear(width, width)

    def forward(self, hidden: Tensor) -> Tensor:
        rows = hidden.movedim((self.axis, 1), (-2, -1))
        query, key, value = self.project(rows).unflatten(-1, (3, self.heads, -1)).movedim(-3, 0).transpose(-2, -3)
        angles = _angles(rows.shape[-2], query.shape[-1] // 2, self.wraps, full_precision(rows[:0]))
        mixed = functional.scaled_dot_product_attention(_rotate(query, angles), _rotate(key, angles), value)
        out: Tensor = self.out(mixed.transpose(-2, -3).flatten(-2))
        return out.movedim((-2, -1), (self.axis, 1))


def _angles(length: int, pairs: int, wraps: bool, like: Tensor) -> Tensor:
    """(L, P) by how much each pair of channels is turned at each place, of the type and on the device of `like`."""
    place, order = (torch.arange(count, device=like.device, dtype=like.dtype) for count in (length, pairs))
    speed = 2 * math.pi / length * (order + 1) if wraps else _SLOWEST ** (-order / max(1, pairs - 1))
    return place[:, None] * speed


def _rotate(rows: Tensor, angles: Tensor) -> Tensor:
    """Rows (..., L, 2 P) with each pair of channels turned by its angle."""
    cos, sin = angles.cos().to(rows.dtype), angles.sin().to(rows.dtype)
    one, other = rows.chunk(2, dim=-1)
    return torch.cat([one * cos - other * sin, one * sin + other * cos], dim=-1)
