"""How fast this machine trains, from a few passes of the network that new configurations have."""

from __future__ import annotations

import torch

from nmpm._support.machine import computes_bfloat16, find_device, free_memory
from nmpm._support.threads import stated_threads, usable_cores
from nmpm.data.grid_rule import MINUTES, Machine, TrainingSize
from nmpm.evaluation.machine import clock_for, one_thread
from nmpm.processors import UNet
from nmpm.processors.base import GridLayout

FRAMES = 8
"""Frames that a call of the network predicts in new configurations."""
_CELLS = {1: 256, 2: 32, 3: 16}  # along each axis, by dimension
_PASSES = 6
_THREADS_GAIN = 0.85  # of a further thread's time: what it saves


def measure_machine(dim: int, minutes: float = MINUTES) -> Machine:
    """This machine, for trainings of so many minutes in `dim` dimensions; takes about a second.

    The network's passes, forwards and backwards, are timed on the device in the precision that `nmpm fit` would take.
    On a CPU it is the time of one thread, which other programs disturb least; its other threads count in proportion.
    """
    device, size, shape = find_device(), TrainingSize.of(dim), (_CELLS[dim],) * dim
    layout = GridLayout(2 * dim + 2, dim, FRAMES, (False,) * dim)
    network = UNet(width=size.width, depth=3, perceptron=(size.width,)).build(layout).to(device)
    grid = torch.zeros(size.batch_size, layout.in_channels, *shape, device=device)
    weights, (_, clock) = [*network.parameters()], clock_for(device)

    def seconds() -> float:
        start = clock()
        with torch.autocast(device.type, torch.bfloat16, enabled=computes_bfloat16(device)):
            error = network(grid).float().square().mean()
        torch.autograd.grad(error, weights)
        return clock() - start

    with one_thread():
        fastest = min(seconds() for _ in range(_PASSES))
    threads = min(stated_threads(None) or usable_cores(), size.batch_size) if device.type == "cpu" else 1
    pace = size.unroll * fastest / (1 + _THREADS_GAIN * (threads - 1))
    memory = float(torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else free_memory()
    return Machine(pace / size.network_seconds(shape), memory, minutes)
