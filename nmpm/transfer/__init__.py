"""Particles to grid and back: the contract and one kernel per file."""

from nmpm.transfer.affine import Affine
from nmpm.transfer.backends import using
from nmpm.transfer.base import Stencil, Transfer, gather, scatter
from nmpm.transfer.linear import Linear
from nmpm.transfer.nearest import Nearest
from nmpm.transfer.quadratic import Quadratic

__all__ = ["Affine", "Linear", "Nearest", "Quadratic", "Stencil", "Transfer", "gather", "scatter", "using"]
