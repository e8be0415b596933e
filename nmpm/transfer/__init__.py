"""Particles to grid and back: the contract, and the kernels that implement it."""

from nmpm.transfer.execution import scatter_backend, without_kernels
from nmpm.transfer.linear import Linear, Nearest
from nmpm.transfer.quadratic import Affine, Quadratic
from nmpm.transfer.transfer import Stencil, Transfer, gather, scatter

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
