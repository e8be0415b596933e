"""How near the simulated scenes come to DeepMind's: standard deviations of velocity and acceleration, beside theirs.

NMPM_TEST_DATA=FOLDER python benchmarks/calibration.py                         all scenes, 40 trajectories each
NMPM_TEST_DATA=FOLDER python benchmarks/calibration.py waterramps --trajectories 8

FOLDER holds `deepmind_metadata` with the `metadata.json` of their datasets, named as they are.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from nmpm._support.progress import progress_bar
from nmpm.data.format import Trajectory
from nmpm.data.generate import preset_metadata
from nmpm.data.simulation import derive_seed
from nmpm.data.statistics import MotionStatistics
from nmpm.sim import load_preset

ORIGINALS = {
    "waterramps": "WaterRamps",
    "sandramps": "SandRamps",
    "multimaterial": "MultiMaterial",
    "waterdrop": "WaterDrop",
}
TARGET = 0.15


def simulated(name: str, trajectories: int, seed: int, workers: int) -> dict[str, list[float]]:
    """Statistics of trajectories of a preset, per frame, particles that move alone."""
    preset = load_preset(name)
    statistics = MotionStatistics(preset_metadata(preset))
    seeds = [derive_seed(seed, index) for index in range(trajectories)]
    with ThreadPoolExecutor(workers) as pool, progress_bar(f"Simulating {name}", trajectories) as advance:
        for made in pool.map(preset.simulate, seeds):
            statistics.add(Trajectory(made.position, made.particle_type))
            advance()
    return statistics.result()


def main() -> None:
    """Simulate, and print one line per scene and quantity."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(ORIGINALS), help="presets (default: all that have originals)")
    parser.add_argument("--trajectories", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    chosen = parser.parse_args()
    folder = Path(os.environ.get("NMPM_TEST_DATA", ".")) / "deepmind_metadata"
    for name in chosen.names:
        original = json.loads((folder / f"{ORIGINALS[name]}.json").read_text(encoding="utf-8"))
        ours = simulated(name, chosen.trajectories, chosen.seed, chosen.workers)
        for key in ("vel_mean", "vel_std", "acc_std"):
            ratio = np.array(ours[key]) / np.array(original[key])
            verdict = "" if key == "vel_mean" else ("within 15%" if np.all(abs(ratio - 1) <= TARGET) else "BEYOND 15%")
            sys.stdout.write(
                f"{name:<14} {key:<9} ours {ours[key][0]:+.3e} {ours[key][1]:+.3e}   theirs {original[key][0]:+.3e} "
                f"{original[key][1]:+.3e}   ratio {ratio[0]:.2f} {ratio[1]:.2f}   {verdict}\n"
            )


if __name__ == "__main__":
    main()
