"""Networks compiled by torch.compile where that works, left as they are where it does not."""

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
        grid: (B, C_in, *S), an input as it will be, to try it with.

    Returns:
        Whether it is compiled: no compiler, or a network that cannot be traced, leaves it as it was.
    """
    network.compile()
    try:
        with torch.no_grad():
            network(grid)
    except Exception as error:  # (what a compiler may raise is nobody's contract)
        network._compiled_call_impl = None
        _LOG.warning("The network is not compiled: %s", str(error).splitlines()[0][:200])
        return False
    return True
