"""Settled shape of trained runs beside the simulator's, held by other constraints than those they were trained with.

python benchmarks/settled_shape.py runs/ramps-0 runs/ramps-1 --scenes 24 --forms free rest_speed=0.01,density_cap=3.6

Scenes are drawn as those of the stress battery, which no dataset holds, and simulated to 5/2 of a trajectory. Columns:
mean height of the particles, particles per occupied cell, and the same in the most crowded twentieth of the cells, over
the simulator's at 1, 5/3 and 5/2 of a trajectory, with 95% intervals (bootstrap over scenes). One row for the simulator
with half of its substeps, and for each run one as it is and one for each form: `free`, or constraints that replace its
own.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from recipes import SHAPE_MEASURES, Run
from timing import make_parser, write_json

from nmpm._support.progress import progress_bar
from nmpm.emulator import Emulator
from nmpm.evaluation.bootstrap import ratio_interval
from nmpm.evaluation.stress.long import Shapes, predicted_shapes, recorded_shapes
from nmpm.evaluation.stress.model import ModelUnderTest, simulate_beside
from nmpm.sim import load_preset
from nmpm.sim.predictability import twin_of

Array = NDArray[np.float64]
TRUTH, TWIN = "simulator", "twin"


def held_to(emulator: Emulator, form: str) -> Emulator:
    """The emulator without its constraints, for `free`, or with some replaced: `rest_speed=0.01,density_cap=3.6`."""
    if form == "free":
        return emulator.unconstrained()
    changes = {name: float(value) for name, value in (pair.split("=") for pair in form.split(","))}
    return emulator.with_constraints(dataclasses.replace(emulator.constraints, **changes))


def list_rows(runs: Sequence[Run], forms: Sequence[str]) -> dict[str, Emulator]:
    """The emulators by the labels of their rows."""
    found = {}
    for run in runs:
        found[run.folder.name] = run.emulator
        found |= {f"{run.folder.name}, {form}": held_to(run.emulator, form) for form in forms}
    return found


def measure(rows: dict[str, Emulator], name: str, frames: Sequence[int], scenes: int) -> Iterator[dict[str, Array]]:
    """Scene by scene, the measures (frames, 3) of the simulator, of its twin and of each emulator."""
    preset, one = load_preset(name), next(iter(rows.values()))
    for truth, twin in simulate_beside(
        ModelUnderTest(name, one, 0, preset), preset, scenes, max(frames), [twin_of(preset)]
    ):
        found = {TRUTH: recorded_shapes(one, truth, frames), TWIN: recorded_shapes(one, twin, frames)}
        found |= {label: predicted_shapes(emulator, truth.initial, frames) for label, emulator in rows.items()}
        yield {label: as_array(shapes, frames) for label, shapes in found.items()}


def as_array(shapes: Shapes, frames: Sequence[int]) -> Array:
    """(frames, 3) measures of one scene."""
    return np.array([[float(getattr(shapes[frame][0], name)) for name in SHAPE_MEASURES] for frame in frames])


def ratio(ours: Array, theirs: Array) -> str:
    """Ratio of the means of measures (scenes,), and its 95% interval by a paired bootstrap."""
    return "{:.2f} ({:.2f}–{:.2f})".format(*ratio_interval(list(ours), list(theirs), resamples=10_000))


def print_table(measured: dict[str, Array], frames: Sequence[int]) -> None:
    """One line per row but the simulator's, from measures (scenes, frames, 3)."""
    heads = [f"{name} at {frame}" for name in SHAPE_MEASURES for frame in frames]
    sys.stdout.write(f"| | {' | '.join(heads)} |\n|---|{'---|' * len(heads)}\n")
    truth = measured[TRUTH]
    for label, own in measured.items():
        if label != TRUTH:
            cells = [ratio(own[:, at, k], truth[:, at, k]) for k in range(own.shape[2]) for at in range(len(frames))]
            sys.stdout.write(f"| {label} | {' | '.join(cells)} |\n")


def main() -> None:
    """Measure, and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="folders of nmpm fit, all of one simulated dataset")
    parser.add_argument("--forms", nargs="*", default=["free"], help="free, or constraints: rest_speed=0.01 (free)")
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    runs = [Run(path) for path in chosen.runs]
    rows, frames, found = list_rows(runs, chosen.forms), runs[0].frames, []
    with progress_bar("Scenes", chosen.scenes) as advance, torch.no_grad():
        for scene in measure(rows, runs[0].config["data"]["name"], frames, chosen.scenes):
            found.append(scene)
            advance()
    measured: dict[str, Any] = {label: np.stack([scene[label] for scene in found]) for label in found[0]}
    print_table(measured, frames)
    write_json(chosen.json, {label: values.tolist() for label, values in measured.items()})


if __name__ == "__main__":
    main()
