"""Training losses: the squared error of positions, and beside it that of the density that they make on the grid."""

from __future__ import annotations

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.particles import Window
from nmpm.scene import Scene
from nmpm.transfer import Linear


def position_error(predicted: Tensor, target: Tensor, mask: Tensor, grid: Grid) -> Tensor:
    """Mean over frames, real particles and dimensions of the squared position error, in cells².

    Args:
        predicted: (B, T, N, D) positions in domain length.
        target: (B, T, N, D), likewise.
        mask: (B, N) bool, False for padding.
        grid: Gives the cells' size.

    Returns:
        (); NaN if there is no real particle. Readers refuse such recordings; a check here would synchronise the GPU.

    Raises:
        ValueError: if the shapes differ.
    """
    if predicted.shape != target.shape:
        raise ValueError(f"Predicted {tuple(predicted.shape)} and target {tuple(target.shape)} positions do not match.")
    squared = grid.to_cell_displacement(predicted - target).square() * mask[:, None, :, None]
    return squared.sum() / (mask.sum() * predicted.shape[1] * predicted.shape[3])


def density_error(predicted: Tensor, target: Tensor, window: Window, scene: Scene, grid: Grid) -> Tensor:
    """Squared error of each material's volume fraction φ on the grid, Σ (φ' - φ)² / (2 Σ φ) over frames and cells.

    Position errors hardly notice a liquid that slowly loses its volume, as neighbours swap places all the time; its
    density tells. As Σ φ is the particles' volume, the error is a mean over particles, as the position error is.

    Args:
        predicted: (B, F, N, D) positions in domain length, at F frames.
        target: (B, F, N, D), likewise.
        window: Says which particles are real and of which material.
        scene: Gives the materials and a particle's volume.
        grid: Where densities are compared, by linear weights.

    Returns:
        A number; NaN if there is no real particle.
    """
    kinds = torch.arange(len(scene.materials), device=window.material.device)
    member = (window.material.unsqueeze(-1) == kinds) & window.mask.unsqueeze(-1)
    weight = member.to(torch.float32).repeat_interleave(predicted.shape[1], dim=0)
    fraction = scene.particle_volume / grid.cell_volume
    found, true = (
        fraction * Linear().p2g(weight, grid.to_cells(frames.flatten(0, 1)), grid) for frames in (predicted, target)
    )
    return (found - true).square().sum() / (2 * fraction * weight.sum())
