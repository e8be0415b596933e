"""How fast the simulators are: million particle-substeps per second, on one core and on all.

python benchmarks/simulators.py                   every shipped preset of the material point method
python benchmarks/simulators.py goop waterramps --frames 100 --repeats 5 --json simulators.json
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from nmpm.sim import MpmPreset, Preset, load_preset, preset_names
from nmpm.sim.preset import BOUNDARY


def rate(preset: Preset, workers: int, seed: int) -> float:
    """Million particle-substeps per second of as many trajectories at a time as there are workers."""
    start = time.perf_counter()
    with ThreadPoolExecutor(workers) as pool:
        made = list(pool.map(preset.simulate, range(seed, seed + workers)))
    seconds = time.perf_counter() - start
    moving = sum(int((run.particle_type != BOUNDARY).sum()) for run in made)
    return moving * preset.frames * preset.substeps / seconds / 1e6


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="presets (default: all of the material point method)")
    parser.add_argument("--frames", type=int, default=60, help="of each trajectory (default: 60)")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    chosen = parser.parse_args()
    cores, rows = os.cpu_count() or 1, []
    names = chosen.names or [name for name in preset_names() if load_preset(name).solver == MpmPreset.solver]
    sys.stdout.write(f"million particle-substeps/s, median (least-most) of {chosen.repeats}; {cores} cores\n")
    for name in names:
        preset = load_preset(name)
        preset.with_frames(1).simulate(0)  # compiles
        preset = preset.with_frames(chosen.frames)
        # Alternating, so that both see the same machine.
        rates = {workers: [0.0] * chosen.repeats for workers in (1, cores)}
        for repeat in range(chosen.repeats):
            for workers in rates:
                rates[workers][repeat] = rate(preset, workers, 100 * repeat)
        one, every = (statistics.median(values) for values in rates.values())
        spread = [f"{min(values):.1f}-{max(values):.1f}" for values in rates.values()]
        sys.stdout.write(f"{name:<17}one core {one:5.1f} ({spread[0]})   all {every:5.1f} ({spread[-1]})\n")
        rows.append({"preset": name, "one": rates[1], "all": rates[cores]})
    if chosen.json:
        chosen.json.write_text(json.dumps({"cores": cores, "rates": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
