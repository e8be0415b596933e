"""What the kernels need to know of an emulator but its weights: plain numbers, and arrays made of them once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from nmpm.decoders import Absolute, Acceleration, Blend, Decoder, Flip, Residual
from nmpm.emulator.support import floor_rows
from nmpm.transfer import Affine, Linear, Nearest, Quadratic, Transfer

if TYPE_CHECKING:
    from nmpm.emulator.recipe import EmulatorRecipe

Array = NDArray[Any]
Reals = tuple[float, ...]

_SCATTER_NODES: Mapping[type[Transfer], int] = MappingProxyType({Nearest: 1, Linear: 2, Quadratic: 3, Affine: 0})
_GATHER_NODES: Mapping[type[Transfer], int] = MappingProxyType({Nearest: 2, Linear: 2, Quadratic: 3, Affine: 3})
"""Nodes along an axis; 0: the kernels cannot do it. Subclasses may do something else, so exactly these types count."""

_SHARES: Mapping[type[Decoder], Callable[[Any], Reals]] = MappingProxyType(
    {
        Absolute: lambda _: (0.0, 0.0, 0.0, 0.0),
        Residual: lambda _: (0.0, 1.0, 1.0, 0.0),
        Flip: lambda _: (1.0, 0.0, 1.0, 0.0),
        Blend: lambda blend: (blend.flip, 1 - blend.flip, 1.0, 0.0),
        Acceleration: lambda _: (0.0, 1.0, 1.0, 1.0),
    }
)
"""Decoders as shares of the particle's own and the grid's velocity in the carried one, of gravity, and of the velocity
of the frame before; see `flight.fly`."""


@dataclass(frozen=True)
class Plan:
    """What the kernels compute.

    Args:
        shape, wraps: Cells along each axis, and whether it is periodic.
        lower, spacing: The grid's lower corner and the cells' widths, in domain length.
        scatter_nodes, gather_nodes: Nodes along an axis of the kernels of p2g and g2p.
        particle_volume: In cells.
        solid: Whether the grid state has a solid channel.
        constants: Whether gravity is among its channels.
        decoder: Shares of `flight.fly`.
        mass: Of a particle of each material.
        bounds: Lowest and highest positions in domain length, per axis.
        reflects: Whether particles are mirrored at the bounds instead of stopped.
        rest_speed: Cells per frame; 0 for none.
        obstacles: Whether there can be obstacles.
        solids: Whether particles must keep clear of them.
        floors: As `nmpm.emulator.support.floor_rows`.
        density_cap: Volume fraction above which cells are overfull; 0 for no cap.
    """

    shape: tuple[int, ...]
    wraps: tuple[bool, ...]
    lower: Reals
    spacing: Reals
    scatter_nodes: int
    gather_nodes: int
    particle_volume: float
    solid: bool
    constants: bool
    decoder: Reals
    mass: Reals
    bounds: tuple[Reals, ...]
    reflects: bool
    rest_speed: float
    obstacles: bool
    solids: bool
    floors: tuple[tuple[int, int], ...]
    density_cap: float

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @cached_property
    def size(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)

    @cached_property
    def channels(self) -> int:
        """Number of channels of the grid state."""
        return len(self.mass) * (self.dim + 1) + self.solid + self.dim * self.constants

    @property
    def trains(self) -> bool:
        """Whether trainings take the kernels with gradients, see `nmpm.emulator.fused.training`.

        Not in three dimensions: beside them torch's strided 3-D convolutions in bfloat16 sometimes got weights'
        gradients of unset memory (torch 2.13, CPU with AVX-512), which they do not beside tensor operations.
        """
        return self.dim == 2 and self.scatter_nodes == self.gather_nodes == 2 and not self.reflects

    @cached_property
    def scatter_grid(self) -> tuple[Any, ...]:
        """Shape, periodic axes and nodes as the kernels of p2g take them."""
        return self.shape, self.wraps, (0,) * self.scatter_nodes

    @cached_property
    def gather_grid(self) -> tuple[Any, ...]:
        """The same for g2p."""
        return self.shape, self.wraps, (0,) * self.gather_nodes

    @cached_property
    def box(self) -> Array:
        """(2, D) the grid's lower corner and the cells' widths, in domain length."""
        return np.array((self.lower, self.spacing), np.float32)

    @cached_property
    def limits(self) -> Array:
        """(3, D) lowest and highest positions in cells, infinite on periodic axes; 1 in the last row to reflect."""
        ends = (np.array(self.bounds).T - np.array(self.lower)) / np.array(self.spacing)
        free = np.array(self.wraps)
        low, high = np.where(free, -np.inf, ends[0]), np.where(free, np.inf, ends[1])
        return np.array((low, high, np.full(self.dim, self.reflects)), np.float32)

    @cached_property
    def ratio(self) -> Array:
        """(D,) widths of the cells over that of the first axis; 1 where they are square to rounding."""
        ratio = np.array(self.spacing) / self.spacing[0]
        return np.where(np.all(np.abs(ratio - 1) < 1e-6), 1.0, ratio).astype(np.float32)

    @cached_property
    def floor_rows(self) -> Array:
        """(D, 2) int64."""
        return np.array(self.floors, np.int64)

    @property
    def volume_channels(self) -> tuple[int, int]:
        """The grid state's first channel that is a volume fraction, and the one after the last."""
        return len(self.mass) * self.dim, len(self.mass) * (self.dim + 1)

    @cached_property
    def masses(self) -> Array:
        """(M,) float32."""
        return np.array(self.mass, np.float32)

    @cached_property
    def shares(self) -> tuple[np.float32, ...]:
        """The decoder's shares in float32."""
        return tuple(map(np.float32, self.decoder))


def make_plan(recipe: EmulatorRecipe) -> Plan | None:
    """The plan of an emulator; None if it has parts that the kernels do not know, or lies too far off for float32."""
    scene, grid, constraints = recipe.scene, recipe.grid, recipe.constraints
    nodes = _SCATTER_NODES.get(type(recipe.transfer), 0)
    shares = _SHARES.get(type(recipe.decoder))
    if scene.dim == 1 or not nodes or shares is None or constraints.bounds not in ("stop", "reflect"):
        return None
    if scene.fields:
        return None
    if not grid.resolves(torch.float32):
        return None
    return Plan(
        shape=grid.shape,
        wraps=grid.periodic,
        lower=grid.lower,
        spacing=grid.spacing,
        scatter_nodes=nodes,
        gather_nodes=_GATHER_NODES[type(recipe.transfer)],
        particle_volume=scene.particle_volume / grid.cell_volume,
        solid=scene.walled,
        constants=scene.gravity_varies,
        decoder=shares(recipe.decoder),
        mass=scene.densities or (1.0,) * len(scene.materials),
        bounds=scene.bounds,
        reflects=constraints.bounds == "reflect",
        rest_speed=constraints.rest_speed,
        obstacles=scene.obstacles,
        solids=constraints.solids,
        floors=floor_rows(scene, grid),
        density_cap=constraints.density_cap,
    )
