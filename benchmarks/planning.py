"""Estimate what a training takes: time and memory against particles, grid, unrolled bundles and devices.

python benchmarks/planning.py --device cpu
python benchmarks/planning.py --device cuda --batch 16 --json plan.json

One step of each size is measured in a new process, with and without recomputation of activations. Times on several
devices are computed, not measured: they are marked with a star, and neglect that devices wait for one another.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import torch
from timing import (
    Spread,
    describe_machine,
    make_timing_parser,
    peak_bytes,
    run_in_process,
    time_alternating,
    write_json,
)
from workloads import DEFAULT_SETUP, PRESETS, SETUPS, TrainingStep

SIZES = ("64x64:2000", "64x64:20000", "64x64:200000", "128x128:2000", "128x128:20000", "256x256:20000",
         "32x32x32:10000", "64x64x64:100000")  # fmt: skip
STEPS, SCENES = 100_000, 16
DEVICES = (2, 4, 8)


def measure_step(grid: str, particles: int, options: dict[str, Any], threads: int, rounds: int) -> dict[str, Any]:
    """Seconds of a training step, and the most memory that it holds, in bytes."""
    torch.set_num_threads(threads)
    cells = tuple(int(side) for side in grid.split("x"))
    step = TrainingStep(SETUPS[DEFAULT_SETUP], preset=PRESETS[len(cells)], particles=particles, cells=cells, **options)
    peak = peak_bytes(step, options["device"])  # warms up, too
    return {"seconds": Spread.of(time_alternating({"": step}, rounds, warm_up=0)[""]), "bytes": peak}


def measure_size(grid: str, particles: int, options: dict[str, Any], threads: int, rounds: int) -> dict[str, Any]:
    """A step with activations stored, and with activations recomputed."""
    stored, recomputed = (
        run_in_process(partial(measure_step, grid, particles, options | {"recompute": recompute}, threads, rounds))
        for recompute in (False, True)
    )
    hours = stored["seconds"].median / options["batch"] * SCENES * STEPS / 3600
    return {"grid": grid, "particles": particles, "plain": stored, "recomputed": recomputed, "hours": hours}


def format_row(row: dict[str, Any], batch: int) -> str:
    """A line of the table."""
    stored, recomputed = row["plain"], row["recomputed"]
    several = "".join(f"{row['hours'] / devices:>9.3g}*" for devices in DEVICES)
    return (
        f"{row['grid']:>10}{row['particles']:>10}{stored['seconds'].format(batch / 1000):>26}"
        f"{recomputed['seconds'].median / stored['seconds'].median:>8.2f}{1e-9 * stored['bytes'] / batch:>10.3g}"
        f"{1e-9 * recomputed['bytes'] / batch:>12.3g}{row['hours']:>9.3g}{several}\n"
    )


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--sizes", nargs="+", default=SIZES, metavar="GRID:PARTICLES", help="e.g. 64x64:2000")
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--width", type=int, default=32)
    parser.add_argument("--unroll", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    options = {name: getattr(chosen, name) for name in ("batch", "width", "unroll", "device")}
    machine = describe_machine(chosen.device, chosen.threads)
    sys.stdout.write(f"{machine}; {options | {'device': str(chosen.device)}}; 8 frames a bundle\n")
    sys.stdout.write(
        f"{'grid':>10}{'particles':>10}{'ms per step and scene':>26}{'recomp.':>8}{'GB/scene':>10}{'recomputed':>12}"
        f"   hours for {STEPS:,} steps of {SCENES} scenes, on 1, {', '.join(map(str, DEVICES))} devices\n"
    )
    rows = []
    for size in chosen.sizes:
        grid, _, particles = size.partition(":")
        rows.append(measure_size(grid, int(particles), options, chosen.threads, chosen.rounds))
        sys.stdout.write(format_row(rows[-1], chosen.batch))
        sys.stdout.flush()
    write_json(chosen.json, {"machine": machine, "options": options, "sizes": rows})


if __name__ == "__main__":
    main()
