"""Compiling networks by torch.compile where that works."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from nmpm.processors import GridProcessor

_LOG = logging.getLogger(__name__)


def compile_network(network: GridProcessor, grid: Tensor) -> bool:
    """Compile a network in place; names and weights stay, and so do its checkpoints.

    Args:
        network: What to compile.
        grid: (B, C_in, *S), an example of the input, to try it with.

    Returns:
        Whether it is compiled. Without a compiler, or if the network cannot be traced, it stays as it was.
    """
    network.compile()
    try:
        with torch.no_grad():
            network(grid)
    except Exception as error:  # (compilers document no exceptions)
        network._compiled_call_impl = None
        _LOG.warning("The network is not compiled: %s", str(error).splitlines()[0][:200])
        return False
    return True
