"""Errors and speed of the zoo's models on a GPU beside the CPU's, on the same simulated scenes.

python benchmarks/zoo_on_device.py --device cuda
python benchmarks/zoo_on_device.py --zoo goop --scenes 2 --frames 100 --json zoo.json

Errors are mean squared distances × 10⁻³ from the simulator; times are per frame of one scene. Positions on the two
devices drift apart as rounding errors grow; their largest difference is given in cells after 8 frames and at the end.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from timing import describe_machine, make_timing_parser, time_run, write_json
from torch import Tensor
from workloads import simulate_windows

from nmpm.emulator import rollout
from nmpm.evaluation.comparison import Comparison
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.sim import Preset, load_preset, preset_names
from nmpm.zoo import Zoo

SEED = 11


@dataclass(frozen=True)
class Rollouts:
    """A model's rollouts of several scenes on one device.

    Args:
        positions: Of each scene, (1, T, N, D), on the CPU.
        errors: Against the simulator, × 10⁻³, by metric.
        milliseconds: Per frame, median of the scenes.
    """

    positions: list[Tensor]
    errors: dict[str, float]
    milliseconds: float


def roll_out(name: str, windows: Sequence[Window], device: torch.device) -> Rollouts:
    """Roll a zoo model out on a device; each scene twice, of which the second is timed."""
    emulator = Zoo.load(name, device=device).emulator
    comparison = Comparison(emulator.scene, [MSE((32, 100))])
    positions, milliseconds = [], []
    for window in windows:
        frames = window.target.shape[1]
        run = partial(rollout, emulator, window.initial.to(device), frames)
        positions.append(run().cpu())
        milliseconds.append(1e3 * time_run(run) / frames)
        comparison.update(window, positions[-1])
    errors = {key: 1e3 * float(value) for key, value in comparison.compute().items()}
    return Rollouts(positions, errors, statistics.median(milliseconds))


def compare_devices(name: str, preset: Preset, scenes: int, device: torch.device) -> dict[str, object]:
    """Print and return a model's figures on the CPU and on a device."""
    windows = list(simulate_windows(preset, SEED, scenes, workers=1))
    cell = min(Zoo.load(name).emulator.grid.spacing)
    places = {"cpu": torch.device("cpu"), str(device): device}
    found = {place: roll_out(name, windows, where) for place, where in places.items()}
    here, there = found["cpu"].positions, found[str(device)].positions
    gaps = [(a - b).abs().amax((0, 2, 3)) / cell for a, b in zip(here, there, strict=True)]
    early, late = (max(float(gap[:frames].max()) for gap in gaps) for frames in (8, None))
    for place, rollouts in found.items():
        errors = "  ".join(f"{key} {value:.4g}" for key, value in rollouts.errors.items())
        sys.stdout.write(f"{name:<16}{place:<8}{errors}  {rollouts.milliseconds:.3g} ms/frame\n")
    sys.stdout.write(f"{name:<16}largest difference {early:.1e} cells after 8 frames, {late:.1e} at the end\n")
    sys.stdout.flush()
    figures = {place: {"errors": r.errors, "ms_per_frame": r.milliseconds} for place, r in found.items()}
    return figures | {"cells_after_8": early, "cells_at_end": late}


def main() -> None:
    """Compare each model that has a simulator, print, and write JSON if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--zoo", nargs="+", help="models (default: all that are named after a shipped preset)")
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--frames", type=int, default=200, help="of each scene (default: 200)")
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    machine = describe_machine(chosen.device, chosen.threads)
    sys.stdout.write(f"{machine}; {chosen.scenes} scenes of {chosen.frames} frames\n")
    presets = {name: name.partition("/")[0] for name in chosen.zoo or Zoo.list()}
    known = {name: preset for name, preset in presets.items() if preset in preset_names()}
    models = {
        name: compare_devices(name, load_preset(preset).with_frames(chosen.frames), chosen.scenes, chosen.device)
        for name, preset in known.items()
    }
    write_json(chosen.json, {"machine": machine, "models": models})


if __name__ == "__main__":
    main()
