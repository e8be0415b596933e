"""The training loss: mean squared position error in cells², over every predicted frame and the particles that move."""

from __future__ import annotations

from torch import Tensor

from nmpm.grid import Grid


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
