"""Coarser simulations at their fewest stable substeps, beside the shipped setting, over whole trajectories.

python benchmarks/stable_substeps.py                      every shipped preset that simulates 100 frames in seconds
python benchmarks/stable_substeps.py waterramps --factors 1 2 4 8 --scenes 8
python benchmarks/stable_substeps.py waterramps --factors 1 --substeps 5 6 7 8 --scenes 12

Prints a Markdown table of `Preset.coarsened`: CPU time per frame, mean squared error of the positions against the
shipped setting on the same scenes beside that of nothing moving (both × 10⁻³, over all frames), and the largest kinetic
and potential energy over the initial one, which 1 bounds if a simulation is stable. Where coarser particles are other
ones (SPH), positions cannot be compared.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError
from nmpm.sim import Preset, load_preset, preset_names
from nmpm.sim.preset import BOUNDARY

Positions = NDArray[np.float32]

HEADER = """\
| preset | factor | substeps | CPU ms per frame | MSE | nothing moves | largest energy |
| --- | --- | --- | --- | --- | --- | --- |
"""


@dataclass(frozen=True)
class Run:
    """One trajectory.

    Args:
        position: (T, N, D) of the particles that move.
        milliseconds: CPU time per frame.
        energy: Largest over the initial one.
    """

    position: Positions
    milliseconds: float
    energy: float


def main() -> None:
    """Measure and print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="presets (default: all but wbcsph, which takes an hour)")
    parser.add_argument("--factors", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--substeps", type=int, nargs="+", default=[], help="instead of the fewest stable ones")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--frames", type=int, help="of each trajectory (default: the preset's)")
    chosen = parser.parse_args()
    sys.stdout.write(HEADER)
    for name in chosen.names or [name for name in preset_names() if name != "wbcsph"]:
        preset = load_preset(name)
        preset = preset.with_frames(chosen.frames or preset.frames)
        for line in rows(preset, chosen.factors, chosen.substeps, range(chosen.scenes)):
            sys.stdout.write(line)
            sys.stdout.flush()


def rows(preset: Preset, factors: list[int], substeps: list[int], seeds: range) -> Iterator[str]:
    """Of one preset: the shipped setting, then every factor at its fewest stable substeps or at the given ones."""
    preset.with_frames(1).simulate(0)  # compiles
    shipped = [simulated(preset, seed) for seed in seeds]
    still = 1e3 * float(np.mean([np.mean((run.position - run.position[0]) ** 2) for run in shipped]))
    yield row(preset, "shipped", shipped, "–", still)
    for factor in factors:
        coarse = preset.coarsened(factor)
        for count in substeps or [coarse.substeps]:
            try:
                changed = dataclasses.replace(coarse, substeps=count)
                runs = [simulated(changed, seed) for seed in seeds]
            except ConfigError as error:
                sys.stderr.write(f"factor {factor}, {count} substeps: {error}\n")
                continue
            yield row(changed, str(factor), runs, error_between(runs, shipped), still)


def row(preset: Preset, factor: str, runs: list[Run], error: str, still: float) -> str:
    """One line of the table."""
    cost, most = np.mean([run.milliseconds for run in runs]), max(run.energy for run in runs)
    return f"| {preset.name} | {factor} | {preset.substeps} | {cost:.2f} | {error} | {still:.0f} | {most:.4g} |\n"


def simulated(preset: Preset, seed: int) -> Run:
    """One trajectory of a preset."""
    start = preset.draw(seed)
    begin = time.process_time()
    made = preset.simulate_from(start, preset.frames)
    milliseconds = 1e3 * (time.process_time() - begin) / preset.frames
    position = made.position[:, made.particle_type != BOUNDARY]
    gravity = np.array(start.gravity)
    low, high = np.array(preset.box).T
    bottom = np.where(gravity > 0, high, low)  # where the potential energy is least
    speed = np.diff(position.astype(np.float64), axis=0) / preset.frame_dt
    kinetic = (speed**2).sum(-1).mean(-1) / 2
    middle = (position[1:].mean(1) + position[:-1].mean(1)) / 2
    initial = (start.velocity**2).sum(-1).mean() / 2 - (start.position.mean(0) - bottom) @ gravity
    return Run(position, milliseconds, float((kinetic - (middle - bottom) @ gravity).max() / initial))


def error_between(runs: list[Run], reference: list[Run]) -> str:
    """Mean squared error × 10⁻³ of all scenes, or a dash if the particles are others."""
    if any(one.position.shape != other.position.shape for one, other in zip(runs, reference, strict=True)):
        return "–"
    errors = [np.mean((one.position - other.position) ** 2) for one, other in zip(runs, reference, strict=True)]
    return f"{1e3 * np.mean(errors):.2f}"


if __name__ == "__main__":
    main()
