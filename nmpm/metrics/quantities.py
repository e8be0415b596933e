"""What the positions of a scene amount to: densities on a grid, front, height, energies, and how crowded they are."""

from __future__ import annotations

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.transfer import Linear, Nearest

_FRONT = 0.95  # of the volume is behind the front
_MOST_CROWDED = 0.05  # of the occupied cells: those whose crowding is averaged


def into_domain(scene: Scene, position: Tensor) -> Tensor:
    """Positions (..., D) moved into the domain: by whole periods, and to the border at walls."""
    columns = []
    for along, (low, high), periodic in zip(position.unbind(-1), scene.domain, scene.periodic, strict=True):
        columns.append(low + (along - low).remainder(high - low) if periodic else along.clamp(low, high))
    return torch.stack(columns, dim=-1)


def volume_fractions(scene: Scene, grid: Grid, position: Tensor, material: Tensor, volume: Tensor) -> Tensor:
    """Density of each of the scene's M materials: its volume fraction on the grid by linear weights, (K, M, *S).

    Args:
        scene: Gives domain, materials and the particles' volume.
        grid: Over the domain.
        position: (K, N, D), finite; those outside of the domain count as `into_domain` moves them.
        material: (N,) index into the scene's materials.
        volume: (N,) or (K, N) of each particle as a multiple of the scene's `particle_volume`; 0 where it is not there.
    """
    kinds = torch.nn.functional.one_hot(material, len(scene.materials)).to(position.dtype)
    values = (kinds * volume.to(kinds).unsqueeze(-1)).expand(len(position), -1, -1)
    filled: Tensor = Linear().p2g(values, grid.to_cells(into_domain(scene, position), position.dtype), grid)
    return filled * (scene.particle_volume / grid.cell_volume)


def front(scene: Scene, start: Tensor, position: Tensor, gravity: Tensor, volume: Tensor) -> Tensor:
    """How far the material has advanced, (K,): the distance across gravity that 95% of the volume is within.

    Args:
        scene: Gives the periods, across which distances are the shortest.
        start: (N, D), from whose centre of volume the distance counts.
        position: (K, N, D).
        gravity: (D,); where it is zero, all directions count.
        volume: (N,) of each particle, in any unit.
    """
    share = (volume / volume.sum()).to(position.dtype)
    offset = position - share @ start
    for axis, (low, high) in enumerate(scene.domain):
        if scene.periodic[axis]:
            period = high - low
            offset[..., axis] = (offset[..., axis] + period / 2).remainder(period) - period / 2
    down = torch.nn.functional.normalize(gravity.to(position.dtype), dim=-1)
    distance, order = (offset - (offset @ down).unsqueeze(-1) * down).norm(dim=-1).sort(dim=-1)
    index = (share[order].cumsum(-1) < _FRONT).sum(-1, keepdim=True).clamp(max=len(share) - 1)
    reached: Tensor = distance.gather(-1, index)
    return reached.squeeze(-1)


def energies(
    scene: Scene, path: Tensor, material: Tensor, gravity: Tensor, volume: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Kinetic, and kinetic and potential energy per mass between frames, (T - 1, …), of a path (T, …, N, D).

    Args:
        scene: Gives bounds and densities.
        path: Positions of all moving particles, float64.
        material: (N,) index into the scene's materials.
        gravity: (D,) in length per frame squared, float64.
        volume: (N,) of each particle, in any unit; all the same when left out.
    """
    mass = torch.tensor(scene.densities or (1.0,) * len(scene.materials), dtype=torch.float64)[material]
    mass = mass if volume is None else mass * volume
    share = mass / mass.sum()
    steps = path.diff(dim=0)
    kinetic = (steps.square().sum(-1) * share).sum(-1) / 2
    middle = (path[1:] + path[:-1]) / 2
    low, high = torch.tensor(scene.bounds, dtype=torch.float64).T
    floor = torch.where(gravity < 0, low, high)
    return kinetic, kinetic - (((middle - floor) @ gravity) * share).sum(-1)


def mean_height(scene: Scene, position: Tensor, gravity: Tensor, volume: Tensor) -> Tensor:
    """Mean height above the lowest bound against gravity, (B,), in domain length, of positions (B, N, D).

    Gravity, (B, D) or (1, D), is not zero; volumes, (B, N) or (1, N), are 0 for padding.
    """
    up = -torch.nn.functional.normalize(gravity, dim=-1)
    low, high = position.new_tensor(scene.bounds).T
    floor = torch.minimum(up * low, up * high).sum(-1)
    heights = (position * up.unsqueeze(1)).sum(-1) - floor.unsqueeze(1)
    return (heights * volume).sum(1) / volume.sum(1)


def measure_shape(scene: Scene, grid: Grid, state: Particles, position: Tensor) -> dict[str, Tensor]:
    """How high the material of B scenes stands, how many cells it occupies and how crowded these are.

    Gravity must not be zero, and all positions, (B, N, D), be finite.

    Returns:
        (B,) each: `height`, as `mean_height`; `occupied`, the cells that hold a particle; `crowding`, the particles per
        occupied cell; `peak_crowding`, those per cell in the most crowded twentieth of the occupied cells. Particles of
        several sizes count by their volume.
    """
    volume = state.present_volume
    counts = Nearest().p2g(volume.unsqueeze(-1).to(position.dtype), grid.to_cells(position), grid).flatten(1)
    occupied = (counts > 0).sum(1)
    ranked = counts.sort(dim=1, descending=True).values
    kept = (_MOST_CROWDED * occupied).ceil().clamp(min=1)
    first = torch.arange(ranked.shape[1], device=ranked.device) < kept.unsqueeze(1)
    return {
        "height": mean_height(scene, position, state.gravity, volume),
        "occupied": occupied.to(position.dtype),
        "crowding": volume.sum(1) / occupied,
        "peak_crowding": (ranked * first).sum(1) / kept,
    }
