"""How fast this machine trains, from a few passes of the network that new configurations have."""

from __future__ import annotations

import time

import torch

from nmpm._support.devices import computes_bfloat16, find_device
from nmpm._support.memory import free_memory
from nmpm._support.threads import map_ranges, split, stated_threads, usable_cores
from nmpm.data.grid_rule import MINUTES, Machine, TrainingSize
from nmpm.processors import UNet
from nmpm.processors.base import GridLayout

FRAMES = 8
"""Frames that a call of the network predicts in new configurations."""
_CELLS = {1: 256, 2: 32, 3: 16}  # along each axis, by dimension
_PASSES = 8


def measure_machine(dim: int, minutes: float = MINUTES) -> Machine:
    """This machine, for trainings of so many minutes in `dim` dimensions; takes about a second.

    The network's passes, forwards and backwards, are timed on the device, by the threads and in the precision that
    `nmpm fit` would take; the fastest counts, as other programs disturb the others.
    """
    device, size, shape = find_device(), TrainingSize.of(dim), (_CELLS[dim],) * dim
    layout = GridLayout(2 * dim + 2, dim, FRAMES, (False,) * dim)
    network = UNet(width=size.width, depth=3, perceptron=(size.width,)).build(layout).to(device)
    grid = torch.zeros(size.batch_size, layout.in_channels, *shape, device=device)
    threads = (stated_threads(None) or usable_cores()) if device.type == "cpu" else 1

    def passes(low: int, high: int) -> None:
        if threads > 1:
            torch.set_num_threads(1)
        with torch.autocast(device.type, torch.bfloat16, enabled=computes_bfloat16(device)):
            error = network(grid[low:high]).float().square().mean()
        torch.autograd.grad(error, [*network.parameters()])[0].sum().item()  # waits for a GPU

    inner, seconds = torch.get_num_threads(), []
    for _ in range(_PASSES):
        start = time.monotonic()
        map_ranges(passes, split(size.batch_size, -(-size.batch_size // threads)), threads)
        seconds.append(time.monotonic() - start)
    torch.set_num_threads(inner)
    memory = float(torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else free_memory()
    return Machine(size.unroll * min(seconds) / size.seconds(shape, particles=0), memory, minutes)
