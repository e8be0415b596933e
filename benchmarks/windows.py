"""Cost against the occupied share of the grid: a call with the runtime windows, and with eager, alternating.

python benchmarks/windows.py                                      three networks, three grids, 5 to 100% occupied
python benchmarks/windows.py --networks waterramps --grids 256x256 --shares 0.15 --precision bfloat16

Water lies in a corner; its width and height are the same part of the box's. CPU time, one scene. "cells" is the part of
the grid's cells that the network computed, halos included; 1 where the whole grid was chosen.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import torch
from timing import Spread, clock_for, describe_machine, make_timing_parser, time_alternating, write_json

from nmpm.emulator import Emulator
from nmpm.particles import Particles
from nmpm.processors import Patched, Processor, UNet
from nmpm.zoo import Zoo
from nmpm.zoo.pretrained import NETWORK_PRECISIONS

TRAINED = "waterramps"
NETWORKS: dict[str, Processor | None] = {
    TRAINED: None,
    "patched": Patched(UNet(width=32, depth=2, perceptron=(32,))),
    "shallow": UNet(width=32, depth=1, perceptron=(32,)),
}
"""The zoo's, a U-Net of depth 3; untrained ones."""
COLUMNS = ("network", "radius", "grid", "occupied", "cells", "call, ms", "windows", "")
WIDTHS = (11, 8, 9, 10, 7, 10, 9, 7)


def build_emulator(network: str, shape: tuple[int, ...], precision: str) -> Emulator:
    """Waterramps' emulator on a grid of this shape, with its cells' size, and another network if asked for."""
    trained = Zoo.load(TRAINED).emulator
    low, spacing = trained.grid.lower, trained.grid.spacing
    wall = trained.scene.bounds[0][0] - low[0]
    domain = tuple((start, start + n * h) for start, n, h in zip(low, shape, spacing, strict=True))
    bounds = tuple((start + wall, end - wall) for start, end in domain)
    emulator = trained.over(dataclasses.replace(trained.scene, domain=domain, bounds=bounds))
    processor = NETWORKS[network]
    if processor is not None:
        torch.manual_seed(0)
        other = dataclasses.replace(emulator.recipe, processor=processor).build().eval()
        for name, values in emulator.named_buffers():
            other.get_buffer(name).copy_(values)
        emulator = other
    return emulator.requires_grad_(False).with_network(NETWORK_PRECISIONS[precision])


def fill(emulator: Emulator, share: float) -> Particles:
    """Resting water in a corner that fills this share of the box, as densely as in the training."""
    scene = emulator.scene
    step = scene.particle_volume ** (1 / scene.dim)
    sides = [
        torch.arange(low + step / 2, low + (high - low) * share ** (1 / scene.dim), step) for low, high in scene.bounds
    ]
    position = torch.stack(torch.meshgrid(*sides, indexing="ij"), dim=-1).reshape(1, -1, scene.dim)
    count = position.shape[1]
    return Particles(
        position=position,
        velocity=torch.zeros_like(position),
        material=torch.zeros(1, count, dtype=torch.int64),
        mask=torch.ones(1, count, dtype=torch.bool),
        obstacle=position[:, :0],
        obstacle_mask=torch.ones(1, 0, dtype=torch.bool),
        gravity=torch.tensor([scene.gravity]) * scene.dt**2,
    )


@torch.inference_mode()
def measure(emulator: Emulator, state: Particles, rounds: int) -> dict[str, Any]:
    """Seconds of a call on windows and on the whole grid, and the share of the grid's cells that windows computed."""
    parts, context, cells = emulator.with_runtime("windows"), emulator.context(state), []
    hook = emulator.processor.register_forward_pre_hook(lambda _, inputs: cells.append(inputs[0][:, 0].numel()))
    parts(state, context)
    hook.remove()
    calls = {"call_whole": lambda: emulator(state, context), "call_windows": lambda: parts(state, context)}
    seconds = time_alternating(calls, rounds, clock_for(torch.device("cpu")))
    return {"cells": sum(cells) / emulator.grid.size, **{name: Spread.of(values) for name, values in seconds.items()}}


def format_row(row: dict[str, Any]) -> str:
    """A line of the table."""
    times = [str(row[name]) for name in ("network", "radius", "grid")] + [f"{row['share']:.0%}", f"{row['cells']:.2f}"]
    whole, windows = (row[f"call_{where}"].median for where in ("whole", "windows"))
    times += [f"{1e3 * whole:.1f}", f"{1e3 * windows:.1f}", f"{whole / windows:.2f}x"]
    return "".join(f"{text:>{width}}" for text, width in zip(times, WIDTHS, strict=True)) + "\n"


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--networks", nargs="+", choices=list(NETWORKS), default=list(NETWORKS))
    parser.add_argument("--grids", nargs="+", default=["128x64", "256x256", "512x64"])
    parser.add_argument("--shares", type=float, nargs="+", default=[0.05, 0.15, 0.3, 0.6, 1.0])
    parser.add_argument("--precision", choices=list(NETWORK_PRECISIONS), default="float32")
    parser.add_argument("--rounds", type=int, default=9)
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    machine = describe_machine(torch.device("cpu"), chosen.threads)
    header = "".join(f"{text:>{width}}" for text, width in zip(COLUMNS, WIDTHS, strict=True))
    sys.stdout.write(f"{machine}; {chosen.precision}\n{header}\n")
    rows = []
    for network in chosen.networks:
        for grid in chosen.grids:
            emulator = build_emulator(network, tuple(map(int, grid.split("x"))), chosen.precision)
            for share in chosen.shares:
                row = {"network": network, "radius": emulator.processor.radius, "grid": grid, "share": share}
                row |= measure(emulator, fill(emulator, share), chosen.rounds)
                sys.stdout.write(format_row(row))
                sys.stdout.flush()
                rows.append(row)
    write_json(chosen.json, {"machine": machine, "rows": rows})


if __name__ == "__main__":
    main()
