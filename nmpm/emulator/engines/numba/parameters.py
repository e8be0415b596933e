"""What the kernels need of an emulator besides its weights and statistics."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nmpm.decoders import Absolute, Acceleration, Blend, Decoder, Flip, Residual
from nmpm.emulator.engines.torch.support import floor_rows
from nmpm.transfer import Linear, Nearest, Quadratic, Transfer

if TYPE_CHECKING:
    from nmpm.emulator.recipe import EmulatorRecipe

Array = NDArray[Any]

NODES: Mapping[type[Transfer], tuple[int, int]] = MappingProxyType({Nearest: (1, 2), Linear: (2, 2), Quadratic: (3, 3)})
"""Transfers that kernels compute, by their nodes along an axis: of p2g and of g2p."""

DECODERS: Mapping[type[Decoder], Callable[[Any], tuple[float, ...]]] = MappingProxyType(
    {
        Absolute: lambda _: (0.0, 0.0, 0.0, 0.0),
        Residual: lambda _: (0.0, 1.0, 1.0, 0.0),
        Flip: lambda _: (1.0, 0.0, 1.0, 0.0),
        Blend: lambda blend: (blend.flip, 1 - blend.flip, 1.0, 0.0),
        Acceleration: lambda _: (0.0, 1.0, 1.0, 1.0),
    }
)
"""Decoders that kernels compute, as numbers, see `KernelParameters`."""


@dataclass(frozen=True, eq=False)
class KernelParameters:
    """The numbers of an emulator.

    Args:
        shape, wraps: Cells along each axis, and whether it is periodic.
        box: (2, D) the grid's lower corner and the cells' widths, in domain length.
        bounds, ratio: As in `nmpm.emulator.engines.numba`.
        grid, p2g_grid, g2p_grid: Shape, periodic axes, and a tuple as long as a linear transfer, or the model's, has
            nodes along an axis.
        size: Number of cells.
        particle_volume: In cells.
        mass: (M,) of a particle of each material.
        channels: Number of channels of the grid state.
        first_field: Its first one that is a field of particles.
        solid: Whether it has a solid channel.
        constants: Whether gravity is among them.
        decoder: Shares of the particle's own and of the grid's velocity in the one at the start, and of gravity; 1 if
            each frame's velocity is carried to the next.
        rest_speed: Cells per frame; 0 for none.
        obstacles: Whether there can be obstacles.
        solids: Whether particles must keep clear of them.
        floors: (D, 2) int64, as the torch engine's `support.floor_rows`.
        density_cap: Volume fraction above which cells are overfull; 0 for no cap.
    """

    shape: tuple[int, ...]
    wraps: tuple[bool, ...]
    box: Array
    bounds: Array
    ratio: Array
    grid: tuple[Any, ...]
    p2g_grid: tuple[Any, ...]
    g2p_grid: tuple[Any, ...]
    size: int
    particle_volume: float
    mass: Array
    channels: int
    first_field: int
    solid: bool
    constants: bool
    decoder: tuple[np.float32, ...]
    rest_speed: float
    obstacles: bool
    solids: bool
    floors: Array
    density_cap: float

    @property
    def materials(self) -> int:
        return len(self.mass)

    @property
    def volume_channels(self) -> tuple[int, int]:
        """The first channel of the grid state that is a volume fraction, and the one after the last."""
        return self.materials * len(self.shape), self.materials * (len(self.shape) + 1)


def kernel_parameters(recipe: EmulatorRecipe) -> KernelParameters:
    """The parameters of a recipe of which engines with kernels compute all, see `nmpm.emulator.engines.rules`."""
    scene, grid, constraints = recipe.scene, recipe.grid, recipe.constraints
    (p2g, g2p), decoder = NODES[type(recipe.transfer)], type(recipe.decoder)
    spacing = np.array(grid.spacing)
    low, high = (np.array(scene.bounds).T - np.array(grid.lower)) / spacing
    low, high = np.where(scene.confined, low, -np.inf), np.where(scene.confined, high, np.inf)
    ratio = spacing / spacing[0]
    is_square = np.all(np.abs(ratio - 1) < 1e-6)
    return KernelParameters(
        shape=grid.shape,
        wraps=grid.periodic,
        box=np.array((grid.lower, grid.spacing), np.float32),
        bounds=np.array((low, high, np.full(scene.dim, constraints.bounds == "reflect")), np.float32),
        ratio=np.where(is_square, 1.0, ratio).astype(np.float32),
        grid=(grid.shape, grid.periodic, (0, 0)),
        p2g_grid=(grid.shape, grid.periodic, (0,) * p2g),
        g2p_grid=(grid.shape, grid.periodic, (0,) * g2p),
        size=grid.size,
        particle_volume=scene.particle_volume / grid.cell_volume,
        mass=np.array(scene.densities or (1.0,) * len(scene.materials), np.float32),
        channels=len(scene.input_channels),
        first_field=len(dataclasses.replace(scene, evolving=(), properties=(), parameters=()).input_channels),
        solid=scene.walled,
        constants=scene.gravity_varies,
        decoder=tuple(map(np.float32, DECODERS[decoder](recipe.decoder))),
        rest_speed=constraints.rest_speed,
        obstacles=scene.obstacles,
        solids=constraints.solids,
        floors=np.array(floor_rows(scene, grid), np.int64),
        density_cap=constraints.density_cap,
    )
