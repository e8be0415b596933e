"""Cost against the number of particles and the size of the grid, one scene: time of a call and its parts, and memory.

python benchmarks/scaling.py --device cpu                         up to 10⁷ particles, 1024² and 64³ cells
python benchmarks/scaling.py --device cuda --particles 1e3 1e4 1e5 1e6 1e7 4e7 --grids 64x64 1024x1024 128x128x128
python benchmarks/scaling.py --json scaling.json

Each size runs in a new process, so that memory is counted per size. GB/s are of the least that a transfer has to move:
positions and values of the particles once; repeated accesses to grid nodes are not counted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from timing import (
    Spread,
    describe_machine,
    make_timing_parser,
    measure_limits,
    peak_bytes,
    run_in_process,
    time_alternating,
    write_json,
)
from workloads import DEFAULT_SETUP, FRAMES, PRESETS, SETUPS, build_emulator, make_scenes

from nmpm.emulator import Emulator, RolloutContext
from nmpm.emulator.rasterise import grid_state
from nmpm.particles import Particles

WIDTH = 32
FLOAT_BYTES = 4
COLUMNS = ("particles", "grid", "call, ms", "p2g, ms", "GB/s", "m x g2p, ms", "GB/s", "bytes/particle")
COLUMN_WIDTHS = (10, 14, 33, 10, 8, 13, 8, 16)


def build_case(count: int, shape: tuple[int, ...]) -> tuple[Emulator, Particles]:
    """An emulator on a grid of this shape, and blocks of `count` particles."""
    setup = SETUPS[DEFAULT_SETUP]
    scene, state = make_scenes(PRESETS[len(shape)], count, 1)
    emulator = build_emulator(setup, scene, WIDTH, shape).eval().requires_grad_(False)
    emulator.processor.to(setup.precision)
    return emulator, state


def measure_size(count: int, shape: tuple[int, ...], device: torch.device, threads: int, rounds: int) -> dict[str, Any]:
    """Seconds of a call, of p2g and of m times g2p and advection, and bytes per particle beyond the state's own."""
    torch.set_num_threads(threads)
    emulator, state = build_case(count, shape)
    emulator, state = emulator.to(device), state.to(device)
    with torch.inference_mode():
        actions = _split_call(emulator, state, emulator.context(state))
        used = peak_bytes(actions["call"], device)
        seconds = {name: time_alternating({name: run}, rounds, warm_up=1)[name] for name, run in actions.items()}
    parts = {name: Spread.of(values) for name, values in seconds.items()}
    n, dim = state.position.shape[1:]
    least = {"p2g": FLOAT_BYTES * n * (2 * dim + 1), "g2p": FLOAT_BYTES * n * dim * 2 * FRAMES}
    rates = {f"{name}_gb_per_s": 1e-9 * moved / parts[name].median for name, moved in least.items()}
    return {"particles": n, "grid": shape, "bytes_per_particle": used / n, **parts, **rates}


def _split_call(emulator: Emulator, state: Particles, context: RolloutContext) -> dict[str, Callable[[], object]]:
    cells, velocity, _ = emulator.in_cells(state)
    fields = torch.randn(1, FRAMES, state.position.shape[2], *emulator.grid.shape, device=cells.device)

    def advect() -> None:
        position = cells
        for field in fields.unbind(1):
            position = position + 0.01 * emulator.transfer.g2p(field, position, emulator.grid)

    def rasterise() -> object:
        return grid_state(emulator.scene, emulator.grid, emulator.transfer, state, cells, velocity, context.solid)

    return {"call": lambda: emulator(state, context), "p2g": rasterise, "g2p": advect}


def format_row(row: Mapping[str, Any]) -> str:
    """A line of the table."""
    figures = (
        f"{row['particles']}",
        "x".join(map(str, row["grid"])),
        row["call"].format(),
        f"{1e3 * row['p2g'].median:.4g}",
        f"{row['p2g_gb_per_s']:.3g}",
        f"{1e3 * row['g2p'].median:.4g}",
        f"{row['g2p_gb_per_s']:.3g}",
        f"{row['bytes_per_particle']:.0f}",
    )
    return _format_cells(figures)


def _format_cells(texts: tuple[str, ...]) -> str:
    return "".join(f"{text:>{width}}" for text, width in zip(texts, COLUMN_WIDTHS, strict=True)) + "\n"


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--particles", type=float, nargs="+", default=[1e3, 1e4, 1e5, 1e6, 1e7])
    parser.add_argument(
        "--grids", nargs="+", default=["32x32", "64x64", "256x256", "1024x1024", "32x32x32", "64x64x64"]
    )
    parser.add_argument("--rounds", type=int, default=5)
    chosen = parser.parse_args()
    shapes = [tuple(int(side) for side in text.split("x")) for text in chosen.grids]
    sizes: list[tuple[int, tuple[int, ...]]] = [(round(count), (64, 64)) for count in chosen.particles]
    sizes += [(10_000 if len(shape) == 2 else 100_000, shape) for shape in shapes]
    machine = describe_machine(chosen.device, chosen.threads)
    limits = measure_limits(chosen.device, chosen.threads)
    sys.stdout.write(f"{machine}; U-Net {WIDTH} wide; reached at most: {limits}\n{_format_cells(COLUMNS)}")
    rows = []
    for count, shape in sizes:
        row = run_in_process(partial(measure_size, count, shape, chosen.device, chosen.threads, chosen.rounds))
        sys.stdout.write(format_row(row))
        sys.stdout.flush()
        rows.append(row)
    write_json(chosen.json, {"machine": machine, "limits": limits, "sizes": rows})


if __name__ == "__main__":
    main()
