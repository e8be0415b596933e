"""Transfers between particles and grid: the contract, and the two operations every kernel shares.

A kernel gives each particle p a few nodes j and weights w_pj with sum_j w_pj = 1. Then

    scatter (p2g)  S(v)_j = sum_p w_pj v_p          sums over particles, e.g. of mass and momentum
    gather  (g2p)  G(f)_p = sum_j w_pj f_j          interpolation of a grid field

With one kernel both ways the two are adjoint, <S(v), f> = <v, G(f)>. Positions are in cells (see `nmpm.grid`).
Kernel support beyond the last centre of a wall axis is folded onto the border node, so that the weights sum to one
everywhere; on a periodic axis it wraps.

Transfers whose g2p is linear interpolation (cloud-in-cell, bilinear, trilinear), 2 nodes per axis.

Source of `Nearest`: Rochman-Sharabi, Lewin & Louppe, arXiv 2408.15753, section 3.

Quadratic B-spline transfers: one kernel both ways, 3 nodes per axis, continuous gradients.

With `Quadratic` a particle brings only its velocity, which smooths what it scatters: a rotating disc loses spin. With
its own gradient C_p, as in `Affine`,

    (m u)_j = sum_p w_pj (v_p + C_p (x_j - x_p)),

linear velocity fields arrive on the grid as they are. Momentum is conserved, as sum_j w_pj (x_j - x_p) = 0 for any
kernel if x_p stands for the centre of its own weights (the same place, except beside walls). Particles of recordings
have no gradient, so it is fitted anew in each call: at each node by least squares over the particles that touch it,
then gathered back to the particles, by mass.

Sources: the kernel of most material point methods, e.g. Jiang et al., The Material Point Method for Simulating
Continuum Materials, SIGGRAPH 2016 courses, eq. 123; APIC: Jiang et al., The affine particle-in-cell method, SIGGRAPH
2015; the fit: moving least squares, as in Hu et al., A moving least squares material point method, SIGGRAPH 2018.

How transfers are computed: by kernels or tensor operations, in chunks, and with which sum over particles.

A scatter-add backend is the one operation of p2g whose fastest form depends on the hardware, a function

    add(source (B, L, C), index (B, L), size) -> (B, size, C).

All give the same sums to rounding.
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from types import MappingProxyType

import torch
from torch import Tensor
from torch.nn import functional

from nmpm.errors import ConfigError
from nmpm.grid import Grid, per_axis

Add = Callable[[Tensor, Tensor, int], Tensor]

_CHUNK = 2**18  # particles on a CPU
_CHUNK_ELSEWHERE = 2**22  # on a GPU many small chunks would cost more in kernel launches than they save


def chunks(count: int, device: torch.device, values: int = 1) -> list[slice]:
    """Slices, at least one, that cover `count` particles on a device and bound temporary memory; one in traced graphs.

    Chunks shrink in proportion to the intermediate values that the operation needs for each particle.
    """
    if torch.compiler.is_compiling():
        return [slice(None)]
    size = max(1, (_CHUNK if device.type == "cpu" else _CHUNK_ELSEWHERE) // values)
    return [slice(first, first + size) for first in range(0, max(count, 1), size)]


def is_eager_cpu(values: Tensor) -> bool:
    """Whether code may branch on tensor values: on a CPU, not in traced graphs; elsewhere it would halt the device."""
    return values.device.type == "cpu" and not torch.compiler.is_compiling()


def native(source: Tensor, index: Tensor, size: int) -> Tensor:
    """Torch's own `scatter_add`: bit-reproducible on a CPU for any number of threads, not on a GPU."""
    batch, _, channels = source.shape
    everywhere = index.unsqueeze(-1).expand(-1, -1, channels)
    return source.new_zeros(batch, size, channels).scatter_add(1, everywhere, source)


def in_order(source: Tensor, index: Tensor, size: int) -> Tensor:
    """Sort by place, then sum each place's values in order: slower, and bit-reproducible on every device."""
    batch, length, channels = source.shape
    flat = (index + size * torch.arange(batch, device=index.device).unsqueeze(1)).flatten()
    if not len(flat):
        return source.new_zeros(batch, size, channels)
    places, order = torch.sort(flat, stable=True)
    values = source.reshape(batch * length, channels)[order]
    # Neither `bincount` nor checked lengths: on a GPU both read values back.
    lengths = torch.searchsorted(places, torch.arange(batch * size + 1, device=index.device)).diff()
    summed = torch.segment_reduce(values, "sum", lengths=lengths, axis=0, unsafe=True, initial=0.0)
    return summed.reshape(batch, size, channels)


def by_torch_scatter(source: Tensor, index: Tensor, size: int) -> Tensor:
    """The sum of the package torch-scatter; raises ConfigError if it is not installed, or made for another torch."""
    try:
        import torch_scatter
    except (ImportError, OSError) as error:
        raise ConfigError(
            "The backend torch-scatter needs the package, compiled for this torch: pip install setuptools hatchling "
            f'editables && pip install --no-build-isolation -e ".[scatter]" ({error}).'
        ) from error
    summed: Tensor = torch_scatter.scatter(source, index, dim=1, dim_size=size, reduce="sum")
    return summed


BACKENDS: Mapping[str, Add] = MappingProxyType(
    {"native": native, "sorted": in_order, "torch-scatter": by_torch_scatter}
)

_backend: ContextVar[Add | None] = ContextVar("nmpm_scatter_backend", default=None)
_kernels: ContextVar[bool] = ContextVar("nmpm_kernels", default=True)


@contextmanager
def scatter_backend(name: str) -> Iterator[None]:
    """Choose the scatter-add backend of tensor operations within a `with` block; raises ConfigError for unknown names.

    Outside, it is "sorted" if torch is to be deterministic and the device's own sum is not, else "native".
    """
    if name not in BACKENDS:
        raise ConfigError(f"No transfer backend is called {name!r}; there are {', '.join(BACKENDS)}.")
    token = _backend.set(BACKENDS[name])
    try:
        yield
    finally:
        _backend.reset(token)


@contextmanager
def without_kernels() -> Iterator[None]:
    """Compute with tensor operations alone within a `with` block, without kernels."""
    token = _kernels.set(False)
    try:
        yield
    finally:
        _kernels.reset(token)


def is_default() -> bool:
    """Whether code runs outside of `scatter_backend` and `without_kernels`."""
    return kernels_are_on() and _backend.get() is None


def kernels_are_on() -> bool:
    """Whether code runs outside of `without_kernels`."""
    return _kernels.get()


def add(source: Tensor, index: Tensor, size: int) -> Tensor:
    """Sum values (B, L, C) into places (B, L) from 0 to size - 1, (B, size, C)."""
    fallback = in_order if source.is_cuda and torch.are_deterministic_algorithms_enabled() else native
    return (_backend.get() or fallback)(source, index, size)


LEAST_SHARE = 1e-30  # of a particle


@dataclass(frozen=True)
class Stencil:
    """Flat indices (B, N, J) int64 of the nodes that each particle touches, and weights (B, N, J) that sum to one."""

    node: Tensor
    weight: Tensor


class Transfer(ABC):
    """A pair of kernels between particles and grid. Subclasses are stateless and give their stencils."""

    @abstractmethod
    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        """Nodes and weights for p2g of particles at `cells` (B, N, D)."""

    def gather_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        """Nodes and weights for g2p at `cells` (B, N, D); unless overridden, those of p2g."""
        return self.scatter_stencil(cells, grid)

    def p2g(self, values: Tensor, cells: Tensor, grid: Grid) -> Tensor:
        """Sum particle values (B, N, C) at `cells` (B, N, D) onto the nodes, (B, C, *S)."""
        first, *others = (
            scatter(self.scatter_stencil(cells[:, chunk], grid), values[:, chunk], grid.size)
            for chunk in chunks(cells.shape[1], cells.device)
        )
        summed = sum(others, start=first)
        return summed.transpose(1, 2).reshape(summed.shape[0], -1, *grid.shape)

    def momentum(self, velocity: Tensor, membership: Tensor, cells: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
        """Momentum (B, M D, *S) and number (B, M, *S) of each material's particles on the nodes, as `sums`."""
        return self.sums(velocity, membership, cells, grid)

    def sums(self, values: Tensor, membership: Tensor, cells: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
        """Sums (B, M V, *S) of values (B, N, V) over each material's particles, and their numbers (B, M, *S).

        `membership` (B, N, M) is one at a particle's material and zero elsewhere; all zero for padding.
        """
        by_material = (membership.unsqueeze(-1) * values.unsqueeze(-2)).flatten(-2)
        sums = self.p2g(torch.cat([by_material, membership], dim=-1), cells, grid)
        summed, count = sums.split([by_material.shape[-1], membership.shape[-1]], dim=1)
        return summed, count

    def g2p(self, field: Tensor, cells: Tensor, grid: Grid) -> Tensor:
        """Interpolate a grid field (B, C, *S) at `cells` (B, N, D), (B, N, C)."""
        rows, parts = field.flatten(2).transpose(1, 2), chunks(cells.shape[1], cells.device)
        gathered = [gather(self.gather_stencil(cells[:, chunk], grid), rows) for chunk in parts]
        return torch.cat(gathered, dim=1) if len(gathered) > 1 else gathered[0]


def scatter(stencil: Stencil, values: Tensor, size: int) -> Tensor:
    """Sum particle values (B, N, C) onto `size` nodes, (B, size, C): sum_p w_pj v_p."""
    batch, count, channels = values.shape
    touches = stencil.node.shape[-1]
    source = (stencil.weight.unsqueeze(-1) * values.unsqueeze(2)).reshape(batch, count * touches, channels)
    return add(source, stencil.node.reshape(batch, count * touches), size)


def gather(stencil: Stencil, field: Tensor) -> Tensor:
    """Interpolate a node field (B, size, C) at particles, (B, N, C): sum_j w_pj f_j."""
    batch, count, touches = stencil.node.shape
    channels = field.shape[-1]
    index = stencil.node.reshape(batch, count * touches, 1).expand(-1, -1, channels)
    values = field.gather(1, index).reshape(batch, count, touches, channels)
    return torch.einsum("bnj,bnjc->bnc", stencil.weight, values)


def divisors(count: Tensor) -> Tensor:
    """Numbers of particles, and 1 where so small a share of one is seen that gradients of quotients would overflow."""
    return torch.where(count > LEAST_SHARE, count, 1.0)


def tensor_product(base: Tensor, weights: list[Tensor], grid: Grid) -> Stencil:
    """The stencil of K ** D nodes of a kernel that is a product over axes.

    Along each axis the K tensors of `weights` (B, N, D) are those of the nodes base, base + 1, … with `base` (B, N, D)
    int64 not yet folded or wrapped.
    """
    batch, count, dim = base.shape
    node = base.new_zeros(batch, count, 1)
    weight = weights[0].new_ones(batch, count, 1)
    along = torch.stack(weights, dim=-1)
    steps = torch.arange(len(weights), device=base.device)
    for axis in range(dim):
        extent = grid.shape[axis]
        index = base[..., axis, None] + steps
        index = index.remainder(extent) if grid.periodic[axis] else index.clamp(0, extent - 1)
        node = (node.unsqueeze(-1) * extent + index.unsqueeze(-2)).flatten(-2)
        weight = (weight.unsqueeze(-1) * along[..., axis, None, :]).flatten(-2)
    return Stencil(node, weight)


def inside(cells: Tensor, grid: Grid) -> Tensor:
    """Positions (B, N, D) moved into the domain: wrapped on periodic axes, clamped to the faces of wall axes."""
    columns = [
        column.remainder(extent) if wraps else column.clamp(0, extent)
        for column, extent, wraps in zip(cells.unbind(-1), grid.shape, grid.periodic, strict=True)
    ]
    return torch.stack(columns, dim=-1)


def linear_stencil(cells: Tensor, grid: Grid) -> Stencil:
    """The 2 ** D nodes around each particle, weighted by nearness: w = prod_d (1 - |x_d - c_d|)."""
    offset = inside(cells, grid) - 0.5
    base = offset.detach().floor()
    upper = offset - base
    return tensor_product(base.long(), [1 - upper, upper], grid)


def linear_g2p(field: Tensor, cells: Tensor, grid: Grid) -> Tensor:
    """Gather a grid field (B, C, *S) at `cells` (B, N, D) with the linear kernel, (B, N, C).

    In 2-D and 3-D without periodic axes this is torch's own sampler, several times faster than the stencil on a CPU.
    """
    # The sampler's gradient is summed in no fixed order on a GPU.
    loose = cells.is_cuda and torch.are_deterministic_algorithms_enabled()
    if grid.dim == 1 or any(grid.periodic) or loose:
        return gather(linear_stencil(cells, grid), field.flatten(2).transpose(1, 2))
    unit = per_axis(operator.truediv, cells, [extent / 2 for extent in grid.shape]) - 1
    if not cells.is_cuda:
        unit = unit.nan_to_num()  # torch's CPU backward segfaults on NaN coordinates
    points = unit.reshape(unit.shape[0], *(1,) * (grid.dim - 1), *unit.shape[1:])
    last_first = field.transpose(2, -1)  # the order of axes that the sampler wants for coordinates in theirs
    sampled = functional.grid_sample(last_first, points, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled.flatten(2).transpose(1, 2)


@dataclass(frozen=True)
class Linear(Transfer):
    """Linear interpolation both ways: p2g and g2p are adjoint, g2p is exact on linear fields in the interior."""

    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return linear_stencil(cells, grid)

    def g2p(self, field: Tensor, cells: Tensor, grid: Grid) -> Tensor:
        return linear_g2p(field, cells, grid)


@dataclass(frozen=True)
class Nearest(Linear):
    """The paper's pair: p2g averages the particles in each voxel, g2p is linear interpolation.

    p2g is piecewise constant in the positions, so no gradient flows through it to them; the pair is not adjoint.
    """

    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        base = inside(cells.detach(), grid).floor().long()
        return tensor_product(base, [torch.ones_like(cells, requires_grad=False)], grid)

    def gather_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return linear_stencil(cells, grid)


def quadratic_stencil(cells: Tensor, grid: Grid) -> Stencil:
    """The 3 ** D nodes around each particle, weighted by the quadratic B-spline of its distance d to the nearest."""
    offset, nearest = _nearest(cells, grid)
    d = offset - nearest
    weights = [0.5 * (0.5 - d) ** 2, 0.75 - d**2, 0.5 * (0.5 + d) ** 2]
    return tensor_product(nearest.long() - 1, weights, grid)


def _nearest(cells: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Places from the centre of the first node, and the nearest node to each, (B, N, D)."""
    offset = inside(cells, grid) - 0.5
    return offset, (offset.detach() + 0.5).floor()


def quadratic_places(cells: Tensor, grid: Grid) -> Tensor:
    """(B, N, 3 ** D, D) centres of the nodes of `quadratic_stencil`, in its order, in cells; not wrapped."""
    _, nearest = _nearest(cells, grid)
    steps = torch.arange(-1, 2, device=cells.device, dtype=cells.dtype)
    along = []
    for axis in range(grid.dim):
        index = nearest[..., axis, None] + steps
        index = index if grid.periodic[axis] else index.clamp(0, grid.shape[axis] - 1)
        shape = [1] * grid.dim
        shape[axis] = 3
        along.append((index + 0.5).reshape(*index.shape[:2], *shape).expand(-1, -1, *(3,) * grid.dim).flatten(2))
    return torch.stack(along, dim=-1)


@dataclass(frozen=True)
class Quadratic(Transfer):
    """Quadratic B-splines both ways: smoother than `Linear`, at 9 nodes instead of 4 (27 instead of 8 in 3-D)."""

    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return quadratic_stencil(cells, grid)


@dataclass(frozen=True)
class Affine(Quadratic):
    """Quadratic B-splines both ways, velocities with their gradient.

    Args:
        damping: Added to the particles' variance about each node, in cells², so that a few particles in a row or close
            together do not fit steep slopes to their noise. With 0 linear fields are exact to rounding.
    """

    damping: float = 1e-3

    def __post_init__(self) -> None:
        if not 0 <= self.damping < float("inf"):
            raise ConfigError(f"Affine.damping = {self.damping} must not be negative.")

    def momentum(self, velocity: Tensor, membership: Tensor, cells: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
        stencil, places = self.scatter_stencil(cells, grid), quadratic_places(cells, grid)
        centre = torch.einsum("bnj,bnjd->bnd", stencil.weight, places)
        offset = places - centre.unsqueeze(2)
        apart = inside(cells, grid).unsqueeze(2) - places
        slope, count = self._slopes(velocity, membership, stencil, apart, grid)
        gradient = _own(slope, count, membership, stencil)
        at_nodes = velocity.unsqueeze(2) + torch.einsum("bnde,bnje->bnjd", gradient, offset)
        values = torch.einsum("bnm,bnjd->bnjmd", membership, at_nodes).flatten(-2)
        sums = (_scattered(stencil, values, grid.size), count)
        momentum, number = (each.transpose(1, 2).reshape(each.shape[0], -1, *grid.shape) for each in sums)
        return momentum, number

    def _slopes(
        self, velocity: Tensor, membership: Tensor, stencil: Stencil, apart: Tensor, grid: Grid
    ) -> tuple[Tensor, Tensor]:
        """At each node the slopes (B, S, M, D, D) of the velocity, fitted over particles, and their number (B, S, M).

        The fit's variables are the particles' offsets (B, N, J, D) from each node, so that nothing large cancels.
        """
        dim, materials = velocity.shape[-1], membership.shape[-1]
        touches = apart.shape[2]
        one = torch.ones_like(apart[..., :1])
        moved = velocity.unsqueeze(2).expand(-1, -1, touches, -1)
        squares = (apart.unsqueeze(-1) * apart.unsqueeze(-2)).flatten(-2)
        products = (moved.unsqueeze(-1) * apart.unsqueeze(-2)).flatten(-2)
        terms = torch.cat([one, apart, moved, squares, products], dim=-1)
        values = (membership[:, :, None, :, None] * terms.unsqueeze(-2)).flatten(-2)
        sums = _scattered(stencil, values, grid.size).unflatten(-1, (materials, -1))
        count, place_sum, moved_sum, square_sum, product_sum = sums.split([1, dim, dim, dim**2, dim**2], dim=-1)
        total = divisors(count)
        mean, flow = place_sum / total, moved_sum / total
        variance = (square_sum / total).unflatten(-1, (dim, dim)) - mean.unsqueeze(-1) * mean.unsqueeze(-2)
        covariance = (product_sum / total).unflatten(-1, (dim, dim)) - flow.unsqueeze(-1) * mean.unsqueeze(-2)
        # Rounding must not make a variance singular where all particles are in one apart.
        floor = max(self.damping, 16 * torch.finfo(velocity.dtype).eps)
        damped = variance + floor * torch.eye(dim, dtype=variance.dtype, device=variance.device)
        return covariance @ torch.linalg.inv_ex(damped).inverse, count.squeeze(-1)


def _own(slope: Tensor, count: Tensor, membership: Tensor, stencil: Stencil) -> Tensor:
    """(B, N, D, D) the slopes at each particle, of its own material, by mass."""
    batch, size, materials, dim, _ = slope.shape
    weighted = torch.cat([count.unsqueeze(-1) * slope.flatten(-2), count.unsqueeze(-1)], dim=-1)
    gathered = gather(stencil, weighted.reshape(batch, size, -1)).unflatten(-1, (materials, -1))
    weighted_sum: Tensor = (gathered * membership.unsqueeze(-1)).sum(dim=-2)
    summed, mass = weighted_sum.split([dim**2, 1], dim=-1)
    mean: Tensor = (summed / divisors(mass)).unflatten(-1, (dim, dim))
    return mean


def _scattered(stencil: Stencil, values: Tensor, size: int) -> Tensor:
    """Sum values (B, N, J, C) that differ from node to node, (B, size, C)."""
    one_each = Stencil(stencil.node.flatten(1).unsqueeze(-1), stencil.weight.flatten(1).unsqueeze(-1))
    return scatter(one_each, values.flatten(1, 2), size)


__all__ = [
    "Affine",
    "Linear",
    "Nearest",
    "Quadratic",
    "Stencil",
    "Transfer",
    "gather",
    "scatter",
    "scatter_backend",
    "without_kernels",
]
