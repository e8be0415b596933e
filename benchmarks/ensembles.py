"""Ensembles of rollouts: their mean's error, and what their spread says of it.

python benchmarks/ensembles.py runs/ramps-0 runs/ramps-1 runs/ramps-2 --scenes 30 --json ensembles.json

Runs are folders of `nmpm fit` of one recipe, seeds of each other. Rows, MSE × 10³ at 8, 32, 100 frames and over the
full rollout on test scenes, and of the density at the last frame (squared error of the volume fraction over its mean
square, both on the grid), with the ratio to the first row and its 95% interval (paired bootstrap over scenes):

- *one*: the mean of the runs' own errors;
- *mean of rollouts*: particle by particle, frame by frame; the runs roll out by themselves;
- *mean in each call*: all runs predict each bundle from their common mean state;
- *one jittered*, *mean of jittered rollouts*: the first run alone, its grid moved by up to 0.35 cells in every call; as
  many such rollouts.

A mean of n takes n times as long. *Spread*: the mean squared distance of the rollouts from their mean, × 10³, and its
rank correlation over scenes with the error of the first run.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from recipes import HORIZONS, Run, format_error, format_markdown, test_batches
from scipy.stats import spearmanr
from timing import make_parser, write_json
from torch import Tensor

from nmpm.emulator import Bundle, Emulator, RolloutContext, rollout
from nmpm.emulator.rasterise import volume_fraction
from nmpm.emulator.rollouts import Call, unroll_with_gradients
from nmpm.metrics import MSE
from nmpm.particles import Particles, Window
from nmpm.training.augmentation import with_jitter

ONE, OF_ROLLOUTS, IN_CALLS, JITTERED = "one", "mean of rollouts", "mean in each call", "mean of jittered rollouts"
SPREAD = "spread"
JITTER = 0.35
"""Cells; more would move walls out of the domain."""
Figures = dict[str, list[float]]


def roll_out(first: Emulator, state: Particles, frames: int, call: Call) -> Tensor:
    """(B, frames, N, D) by calls that start from the last one's end."""
    bundles = unroll_with_gradients(first, state, -(-frames // first.frames), call)
    return torch.cat([bundle.position for bundle in bundles], dim=1)[:, :frames]


def roll_out_together(emulators: Sequence[Emulator], state: Particles, frames: int) -> Tensor:
    """(B, frames, N, D): each bundle is the mean of what all predict from the common state."""
    contexts = [emulator.context(state) for emulator in emulators]

    def call(_: Emulator, particles: Particles, __: RolloutContext) -> Bundle:
        bundles = [emulator(particles, context) for emulator, context in zip(emulators, contexts, strict=True)]
        position, velocity = ([getattr(bundle, name) for bundle in bundles] for name in ("position", "velocity"))
        return Bundle(torch.stack(position).mean(0), torch.stack(velocity).mean(0))

    return roll_out(emulators[0], state, frames, call)


def roll_out_jittered(emulator: Emulator, state: Particles, frames: int) -> Tensor:
    """(B, frames, N, D) with the grid at another place in each call."""
    return roll_out(emulator, state, frames, lambda own, particles, _: with_jitter(own, JITTER)(particles))


def density(emulator: Emulator, window: Window, position: Tensor) -> Tensor:
    """(B, *S) share of each cell taken by particles at (B, N, D)."""
    cells = emulator.grid.to_cells(position)
    return volume_fraction(emulator.scene, emulator.grid, emulator.transfer, window.mask, cells).squeeze(1)


def errors_of(emulator: Emulator, window: Window, predicted: Tensor) -> Figures:
    """Figures of each scene."""
    metric = MSE(HORIZONS)
    metric.update(window, predicted)
    rows = metric.per_trajectory()
    found = {name: [float(row[name]) for row in rows] for name in rows[0]}
    own, true = (density(emulator, window, frames[:, -1]).flatten(1) for frames in (predicted, window.target))
    found["density"] = ((own - true).square().mean(1) / true.square().mean(1)).tolist()
    return found


def spread_of(window: Window, rollouts: Tensor) -> list[float]:
    """Mean squared distance of n rollouts (n, B, T, N, D) from their mean, of each scene, unbiased."""
    own = rollouts.var(0).mean(-1) * window.mask.unsqueeze(1)
    return (own.sum(-1).mean(1) / window.mask.sum(1)).tolist()


def measure(emulators: Sequence[Emulator], window: Window) -> Mapping[str, Figures]:
    """Figures of each row, and the spreads, by scene."""
    frames, first, state = window.target.shape[1], emulators[0], window.initial
    alone = torch.stack([rollout(emulator, state, frames) for emulator in emulators])
    jittered = torch.stack([roll_out_jittered(first, state, frames) for _ in emulators])
    ones = [errors_of(first, window, predicted) for predicted in alone]
    return {
        ONE: {name: np.mean([own[name] for own in ones], axis=0).tolist() for name in ones[0]},
        OF_ROLLOUTS: errors_of(first, window, alone.mean(0)),
        IN_CALLS: errors_of(first, window, roll_out_together(emulators, state, frames)),
        "one jittered": errors_of(first, window, jittered[0]),
        JITTERED: errors_of(first, window, jittered.mean(0)),
        SPREAD: {"runs": spread_of(window, alone), "jittered": spread_of(window, jittered), "error": ones[0]["mse"]},
    }


def some_scenes(run: Run, scenes: int) -> Iterator[Window]:
    """The first test scenes, in batches."""
    for window in test_batches(run):
        if scenes > 0:
            yield window.scenes(slice(scenes))
        scenes -= len(window.mask)


@torch.no_grad()
def main() -> None:
    """Measure and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="at least two")
    parser.add_argument("--scenes", type=int, default=30)
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    runs = [Run(path.resolve()) for path in chosen.runs]
    emulators = [run.emulator for run in runs]
    found = [measure(emulators, window) for window in some_scenes(runs[0], chosen.scenes)]
    joined = {
        row: {name: [value for part in found for value in part[row][name]] for name in found[0][row]}
        for row in found[0]
    }
    spreads = joined.pop(SPREAD)
    lines = [
        {"rollout": row, **{name: format_error(values, joined[ONE][name]) for name, values in figures.items()}}
        for row, figures in joined.items()
    ]
    sys.stdout.write(format_markdown(lines))
    for name in ("runs", "jittered"):
        correlation = spearmanr(spreads[name], spreads["error"]).statistic
        sys.stdout.write(f"spread of {name} {1e3 * np.mean(spreads[name]):.3g}, rank correlation {correlation:.2f}\n")
    write_json(chosen.json, {**joined, SPREAD: spreads})


if __name__ == "__main__":
    main()
