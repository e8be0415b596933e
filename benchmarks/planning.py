"""What a training will take: time and memory against particles, grid, unrolled bundles and devices.

python benchmarks/planning.py                                        on the CPU
python benchmarks/planning.py --device cuda --batch 16 --json plan.json

One step of each size is measured, in a process of its own, with and without recomputation of activations. What several
devices take is not measured but computed, as if they did not wait for one another, and marked with a star.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import torch
from forms import FORMS, PRESETS, SIZED, Training
from turns import Spread, alone, arguments, machine, most_held, timed, write

SIZES = (("64x64", 2_000), ("64x64", 20_000), ("64x64", 200_000), ("128x128", 2_000), ("128x128", 20_000),
         ("256x256", 20_000), ("32x32x32", 10_000), ("64x64x64", 100_000))  # fmt: skip
STEPS, SCENES = 100_000, 16
DEVICES = (2, 4, 8)


def sized(grid: str, particles: int, options: dict[str, Any], threads: int, rounds: int) -> dict[str, Any]:
    """Seconds of a step, and the bytes that it holds at most."""
    torch.set_num_threads(threads)
    cells = [int(side) for side in grid.split("x")]
    training = Training(FORMS[SIZED], preset=PRESETS[len(cells)], particles=particles, cells=cells, **options)
    held = most_held(training, options["device"])
    return {"seconds": Spread.of([timed(training) for _ in range(rounds)]), "bytes": held}


def row(grid: str, particles: int, options: dict[str, Any], threads: int, rounds: int) -> dict[str, Any]:
    """A size, plain and recomputed."""
    plain, again = (
        alone(partial(sized, grid, particles, options | {"recompute": recompute}, threads, rounds))
        for recompute in (False, True)
    )
    hours = plain["seconds"].median / options["batch"] * SCENES * STEPS / 3600
    return {"grid": grid, "particles": particles, "plain": plain, "recomputed": again, "hours": hours}


def line(found: dict[str, Any], batch: int) -> str:
    """A row of the table."""
    plain, again = found["plain"], found["recomputed"]
    several = "".join(f"{found['hours'] / devices:>9.3g}*" for devices in DEVICES)
    return (
        f"{found['grid']:>10}{found['particles']:>10}{plain['seconds'].shown(batch / 1000):>26}"
        f"{again['seconds'].median / plain['seconds'].median:>8.2f}{1e-9 * plain['bytes'] / batch:>10.3g}"
        f"{1e-9 * again['bytes'] / batch:>12.3g}{found['hours']:>9.3g}{several}\n"
    )


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = arguments(__doc__)
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--width", type=int, default=32)
    parser.add_argument("--unroll", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    options = {name: getattr(chosen, name) for name in ("batch", "width", "unroll", "device")}
    sys.stdout.write(f"{machine(chosen.device, chosen.threads)}; {options}; 8 frames a bundle\n")
    sys.stdout.write(
        f"{'grid':>10}{'particles':>10}{'ms per step and scene':>26}{'recomp.':>8}{'GB/scene':>10}{'recomputed':>12}"
        f"   hours for {STEPS:,} steps of {SCENES} scenes, on 1, {', '.join(map(str, DEVICES))} devices\n"
    )
    rows = []
    for grid, particles in SIZES:
        rows.append(row(grid, particles, options, chosen.threads, chosen.rounds))
        sys.stdout.write(line(rows[-1], chosen.batch))
        sys.stdout.flush()
    write(chosen.json, {"machine": machine(chosen.device, chosen.threads), "options": options, "sizes": rows})


if __name__ == "__main__":
    main()
