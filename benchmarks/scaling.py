"""Cost against the number of particles and the size of the grid, one scene: time of a call and its parts, and memory.

python benchmarks/scaling.py                                      on the CPU, up to 10⁷ particles, 1024² and 64³ cells
python benchmarks/scaling.py --device cuda --particles 1e3 1e4 1e5 1e6 1e7 4e7 --grids 64x64 1024x1024 128x128x128
python benchmarks/scaling.py --json scaling.json

Each size runs in a process of its own, so that its memory is its own. Bytes are the least that a transfer has to move:
positions and values of the particles once; how often grid nodes are touched is not counted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from forms import FORMS, FRAMES, PRESETS, SIZED, emulator, scenes
from turns import Spread, alone, arguments, ceilings, machine, most_held, timed, write

from nmpm.emulator import Emulator, RolloutContext
from nmpm.emulator.rasterise import grid_state
from nmpm.particles import Particles

WIDTH = 32
FLOAT = 4  # bytes
WIDTHS = (10, 14, 33, 10, 8, 13, 8, 16)


def in_a_box(count: int, shape: tuple[int, ...]) -> tuple[Emulator, Particles]:
    """An emulator on a grid, and blocks of so many particles."""
    scene, state = scenes(PRESETS[len(shape)], count, 1)
    made = emulator(FORMS[SIZED], scene, WIDTH, shape).eval().requires_grad_(False)
    made.processor.to(FORMS[SIZED].precision)
    return made, state


def sized(count: int, shape: tuple[int, ...], device: str, threads: int, rounds: int) -> dict[str, Any]:
    """Seconds of a call, of p2g and of m times g2p and advection, and bytes per particle beyond the state's own."""
    torch.set_num_threads(threads)
    made, state = in_a_box(count, shape)
    made, state = made.to(device), state.to(device)
    actions = _parts(made, state, made.context(state))
    with torch.inference_mode():
        used = most_held(actions["call"], device)
    parts = {name: _repeated(action, rounds) for name, action in actions.items()}
    n, dim = state.position.shape[1:]
    least = {"p2g": FLOAT * n * (2 * dim + 1), "g2p": FLOAT * n * dim * 2 * FRAMES}
    rates = {f"{name}_gb_per_s": 1e-9 * moved / parts[name].median for name, moved in least.items()}
    return {"particles": n, "grid": shape, "bytes_per_particle": used / n, **parts, **rates}


def _parts(made: Emulator, state: Particles, context: RolloutContext) -> dict[str, Callable[[], object]]:
    cells, velocity, _ = made.in_cells(state)
    fields = torch.randn(1, FRAMES, state.position.shape[2], *made.grid.shape, device=cells.device)

    def carry() -> None:
        moving = cells
        for field in fields.unbind(1):
            moving = moving + 0.01 * made.transfer.g2p(field, moving, made.grid)

    return {
        "call": lambda: made(state, context),
        "p2g": lambda: grid_state(made.scene, made.grid, made.transfer, state, cells, velocity, context.solid),
        "g2p": carry,
    }


@torch.inference_mode()
def _repeated(action: Callable[[], object], rounds: int) -> Spread:
    action()
    return Spread.of([timed(action) for _ in range(rounds)])


def line(row: Mapping[str, Any]) -> str:
    """A row of the table."""
    figures = (
        f"{row['particles']}",
        "x".join(map(str, row["grid"])),
        row["call"].shown(),
        f"{1e3 * row['p2g'].median:.4g}",
        f"{row['p2g_gb_per_s']:.3g}",
        f"{1e3 * row['g2p'].median:.4g}",
        f"{row['g2p_gb_per_s']:.3g}",
        f"{row['bytes_per_particle']:.0f}",
    )
    return "".join(f"{figure:>{width}}" for figure, width in zip(figures, WIDTHS, strict=True)) + "\n"


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = arguments(__doc__)
    parser.add_argument("--particles", type=float, nargs="+", default=[1e3, 1e4, 1e5, 1e6, 1e7])
    parser.add_argument(
        "--grids", nargs="+", default=["32x32", "64x64", "256x256", "1024x1024", "32x32x32", "64x64x64"]
    )
    parser.add_argument("--rounds", type=int, default=5)
    chosen = parser.parse_args()
    shapes = [tuple(int(side) for side in text.split("x")) for text in chosen.grids]
    sizes = [(round(count), (64, 64)) for count in chosen.particles]
    sizes += [(10_000 if len(shape) == 2 else 100_000, shape) for shape in shapes]
    limits = ceilings(chosen.device, chosen.threads)
    sys.stdout.write(f"{machine(chosen.device, chosen.threads)}; U-Net {WIDTH} wide; reached at most: {limits}\n")
    columns = ("particles", "grid", "call, ms", "p2g, ms", "GB/s", "m x g2p, ms", "GB/s", "bytes/particle")
    sys.stdout.write("".join(f"{column:>{width}}" for column, width in zip(columns, WIDTHS, strict=True)) + "\n")
    rows = []
    for count, shape in sizes:
        row = alone(partial(sized, count, shape, chosen.device, chosen.threads, chosen.rounds))
        sys.stdout.write(line(row))
        sys.stdout.flush()
        rows.append(row)
    write(chosen.json, {"machine": machine(chosen.device, chosen.threads), "limits": limits, "sizes": rows})


if __name__ == "__main__":
    main()
