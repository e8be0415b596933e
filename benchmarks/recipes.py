"""Compare trained runs: errors, late earth mover's distance, settled shape and speed of each beside a baseline's.

python benchmarks/recipes.py runs/patched-0 runs/patched-1 --baseline runs/goop-0 runs/goop-1 --json table.json

Runs are folders of `nmpm fit`; those whose names differ only in a number at the end are seeds of one recipe and make
one row. All runs of a table must be of the same dataset. Columns:

- MSE × 10³ at 8, 32, 100 frames and over the full rollout, on the test split (`nmpm.metrics`);
- EMD × 10³: exact, every 20th frame of the last third, the first `--emd-scenes` test scenes; where a scene has more
  than `--emd-particles`, of that many of its particles, the same ones in both clouds;
- height, particles per occupied cell, and the same in the most crowded twentieth of the cells, over the simulator's,
  after 1, 5/3 and 5/2 of a trajectory (waterramps: frames 600, 1000, 1500), on scenes that no dataset holds, with the
  run's constraints / without them;
- ms per frame: a rollout at batch 1, one thread, CPU time, median of rounds that alternate between the runs;
- ms per training step and minutes of training, from the run's report.

Brackets: 95% interval of the ratio of means to the baseline, paired bootstrap over scenes, after averaging over seeds;
it does not contain the scatter of seeds. Models run in float32, as users run them. Figures are kept in `recipes.json`
in each run's folder, and measured again only if the checkpoint has changed or with `--fresh`; times are measured in
every call that asks for `time`.
"""

from __future__ import annotations

import json
import re
import statistics
import sys
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from timing import clock_for, make_parser, time_alternating, write_json
from torch import Tensor

from nmpm._support.atomic import atomic_write
from nmpm.data.catalog import dataset_home
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator import Emulator, rollout
from nmpm.evaluation.bootstrap import ratio_interval
from nmpm.evaluation.stress.long import predicted_shapes, recorded_shapes, shape_ratios
from nmpm.evaluation.stress.model import ModelUnderTest, simulate_window
from nmpm.metrics import MSE, earth_mover_of_materials
from nmpm.particles import Window
from nmpm.sim import load_preset
from nmpm.training.checkpoints import load_module

HORIZONS = (8, 32, 100)
EMD_EVERY = 20
MULTIPLES = (1.0, 5 / 3, 2.5)
SHAPE_MEASURES = ("height", "crowding", "peak_crowding")
METRICS = ("errors", "shape", "time")
TIMED_FRAMES = 160
RESAMPLES = 10_000


@dataclass(frozen=True)
class Run:
    """A folder of `nmpm fit` and what was measured of it."""

    folder: Path

    @property
    def recipe(self) -> str:
        """The folder's name without the number of the seed."""
        return re.sub(r"-\d+$", "", self.folder.name)

    @cached_property
    def config(self) -> dict[str, Any]:
        """The configuration that the run was started or last gone on with."""
        return dict(yaml.safe_load((self.folder / "config.yaml").read_text(encoding="utf-8")))

    @cached_property
    def report(self) -> dict[str, Any]:
        """The training's report; empty where there is none yet."""
        path = self.folder / "report.json"
        return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}

    @cached_property
    def emulator(self) -> Emulator:
        """The emulator of the best checkpoint, in evaluation mode."""
        return load_module(self.folder / "checkpoints" / "best.ckpt").emulator.eval()

    @property
    def frames(self) -> list[int]:
        """Frames at which shapes are compared, from 1."""
        return [round(multiple * load_preset(self.config["data"]["name"]).frames) for multiple in MULTIPLES]

    def cost(self) -> dict[str, float]:
        """Steps, ms per step and minutes of the training, those of validations included."""
        training = self.report.get("training")
        if not training:
            return {}
        steps, seconds = training["steps"], training["seconds"]
        return {"steps": steps, "ms_per_step": 1e3 * seconds / steps, "minutes": seconds / 60}


class Figures:
    """Figures of a run by metric, kept in its folder as long as its checkpoint stays the same.

    Args:
        run: The run.
        fresh: Whether to forget what was kept.
    """

    def __init__(self, run: Run, fresh: bool) -> None:
        self.path = run.folder / "recipes.json"
        state = (run.folder / "checkpoints" / "best.ckpt").stat()
        self.key = f"{state.st_size}, {state.st_mtime_ns}"
        kept = json.loads(self.path.read_text(encoding="utf-8")) if self.path.is_file() and not fresh else {}
        self.rows: dict[str, Any] = kept if kept.get("checkpoint") == self.key else {"checkpoint": self.key}

    def measure(self, metric: str, settings: str, measure: Callable[[], dict[str, Any]]) -> None:
        """Measure a metric unless that was done before with the same settings."""
        if self.rows.get(metric, {}).get("settings") != settings:
            self.store(metric, {"settings": settings} | measure())

    def store(self, metric: str, values: Mapping[str, Any]) -> None:
        """Keep the values of a metric."""
        self.rows[metric] = dict(values)
        write_json(self.path, self.rows)


def test_batches(run: Run) -> list[Window]:
    """The trajectories of the test split."""
    data = TrajectoryDataModule(**dict(run.config["data"]))
    return list(data.test_dataloader())


def measure_errors(run: Run, chosen: Namespace) -> dict[str, list[float]]:
    """MSE of each test scene, and the late earth mover's distance of the first ones."""
    metric, distances = MSE(HORIZONS), []
    for window in test_batches(run):
        predicted = rollout(run.emulator, window.initial, window.target.shape[1])
        metric.update(window, predicted)
        left = max(0, chosen.emd_scenes - len(distances))
        distances += [late_distance(window, predicted, row, chosen) for row in range(min(left, len(predicted)))]
    rows = metric.per_trajectory()
    return {name: [row[name] for row in rows] for name in rows[0]} | {"emd": distances}


def late_distance(window: Window, predicted: Tensor, row: int, chosen: Namespace) -> float:
    """Mean earth mover's distance over the last third of a trajectory, averaged over materials."""
    length = predicted.shape[1]
    frames = range(EMD_EVERY - 1, length, EMD_EVERY)
    late = [frame for frame in frames if frame >= 2 * length / 3]
    real = window.mask[row]
    clouds = (predicted[row, late][:, real], window.target[row, late][:, real])
    return earth_mover_of_materials(*clouds, window.material[row, real], chosen.emd_particles)


def simulated_window(run: Run, scenes: int) -> Window:
    """Fresh scenes with the simulator's trajectories, simulated once and then kept beside the datasets."""
    name = run.config["data"]["name"]
    path = dataset_home() / "recipes" / f"{name}-{scenes}-{run.frames[-1]}.pt"
    if path.is_file():
        return Window(**torch.load(path, weights_only=True))
    model = ModelUnderTest(name, run.emulator, 0, load_preset(name))
    window = simulate_window(model, load_preset(name), scenes, run.frames[-1])
    with atomic_write(path) as part:
        torch.save(dict(vars(window)), part)
    return window


def measure_shapes(run: Run, chosen: Namespace) -> dict[str, Any]:
    """Height and crowding over the simulator's, by frame, with the run's constraints and without them."""
    window, frames = simulated_window(run, chosen.shape_scenes), run.frames
    simulated = recorded_shapes(run.emulator, window, frames)
    forms = {"held": run.emulator, "free": run.emulator.unconstrained()}
    return {
        name: shape_ratios(predicted_shapes(emulator, window.initial, frames), simulated)
        for name, emulator in forms.items()
    }


def time_runs(runs: Mapping[Path, Run], rounds: int) -> dict[Path, float]:
    """Median ms per frame of each run at batch 1, the runs alternating."""

    def roll_out(run: Run, window: Window) -> None:
        rollout(run.emulator, window.initial.scenes(slice(1)), TIMED_FRAMES)

    windows = {path: test_batches(run)[0] for path, run in runs.items()}
    actions = {path: partial(roll_out, run, windows[path]) for path, run in runs.items()}
    seconds = time_alternating(actions, rounds, clock_for(torch.device("cpu")), warm_up=1)
    return {path: 1e3 * statistics.median(values) / TIMED_FRAMES for path, values in seconds.items()}


def mean_over_seeds(rows: Sequence[Mapping[str, Any]], metric: str) -> dict[str, Any]:
    """Mean of each figure of a metric over runs, for lists element by element; empty where a run lacks the metric."""
    found = [row[metric] for row in rows if metric in row]
    if len(found) < len(rows):
        return {}
    return {name: np.mean([row[name] for row in found], axis=0).tolist() for name in found[0] if name != "settings"}


def group_seeds(runs: Mapping[Path, Run], paths: Sequence[Path]) -> list[list[Path]]:
    """The paths of each recipe's seeds, recipes in the order of their first run."""
    groups: dict[str, list[Path]] = {}
    for path in paths:
        groups.setdefault(runs[path].recipe, []).append(path)
    return list(groups.values())


def summarise(
    found: Mapping[Path, Run], figures: Mapping[Path, Any], seeds: Sequence[Path], baseline: Mapping[str, Any]
) -> dict[str, str]:
    """A table's line for the seeds of one recipe."""
    runs, rows = [found[path] for path in seeds], [figures[path] for path in seeds]
    line = {"recipe": runs[0].recipe, "seeds": str(len(runs))}
    costs = [run.cost() for run in runs]
    for name, digits in (("steps", 0), ("ms_per_step", 0), ("minutes", 1)):
        known = [cost[name] for cost in costs if cost]
        line[name.replace("_", " ")] = f"{statistics.fmean(known):.{digits}f}" if known else "–"
    errors = mean_over_seeds(rows, "errors")
    for name, label in [*((f"mse@{h}", f"MSE@{h}") for h in HORIZONS), ("mse", "full"), ("emd", "late EMD")]:
        line[label] = format_error(errors.get(name), baseline.get(name)) if errors else "–"
    for frame, cell in zip(runs[0].frames, shape_cells(runs, rows), strict=True):
        line[f"shape {frame}"] = cell
    times = mean_over_seeds(rows, "time")
    line["ms per frame"] = f"{times['ms_per_frame']:.3f}" if times else "–"
    return line


def shape_cells(runs: Sequence[Run], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Height, crowding and peak crowding at each frame, with constraints / without."""
    if not all("shape" in row for row in rows):
        return ["–"] * len(runs[0].frames)
    return [
        " / ".join(
            ", ".join(
                f"{statistics.fmean(row['shape'][form][str(frame)][measure] for row in rows):.2f}"
                for measure in SHAPE_MEASURES
            )
            for form in ("held", "free")
        )
        for frame in runs[0].frames
    ]


def format_error(ours: Sequence[float] | None, theirs: Sequence[float] | None) -> str:
    """The mean × 10³, and its ratio to the baseline's with the interval."""
    if not ours:
        return "–"
    mean = f"{1e3 * statistics.fmean(ours):.3g}"
    if theirs is None:
        return mean
    ratio, low, high = ratio_interval(ours, theirs, RESAMPLES)
    return f"{mean} ({ratio:.2f}: {low:.2f}–{high:.2f})"


def format_markdown(lines: Sequence[Mapping[str, str]]) -> str:
    """A markdown table."""
    names = list(lines[0])
    rows = [names, ["---"] * len(names), *([line[name] for name in names] for line in lines)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def measure_all(runs: Mapping[Path, Run], chosen: Namespace) -> dict[Path, dict[str, Any]]:
    """Figures of each run, new or kept."""
    figures = {path: Figures(run, chosen.fresh) for path, run in runs.items()}
    for path, run in runs.items():
        if "errors" in chosen.metrics:
            emd = f"EMD of {chosen.emd_scenes} scenes, {chosen.emd_particles} particles"
            figures[path].measure("errors", emd, partial(measure_errors, run, chosen))
        if "shape" in chosen.metrics:
            figures[path].measure("shape", f"{chosen.shape_scenes} scenes", partial(measure_shapes, run, chosen))
    if "time" in chosen.metrics:
        for path, milliseconds in time_runs(runs, chosen.rounds).items():
            figures[path].store("time", {"ms_per_frame": milliseconds})
    # Through JSON, so that new figures have the same keys as kept ones.
    return {path: json.loads(json.dumps(kept.rows)) for path, kept in figures.items()}


def main() -> None:
    """Measure what was not measured before, and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--baseline", nargs="+", type=Path, default=[])
    parser.add_argument("--metrics", nargs="+", choices=METRICS, default=METRICS)
    parser.add_argument("--emd-scenes", type=int, default=6)
    parser.add_argument("--emd-particles", type=int, default=2000)
    parser.add_argument("--shape-scenes", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=7, help="of timed rollouts")
    parser.add_argument("--fresh", action="store_true", help="measure again what was measured before")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    runs = {path: Run(path.resolve()) for path in dict.fromkeys([*chosen.baseline, *chosen.runs])}
    figures = measure_all(runs, chosen)
    first = mean_over_seeds([figures[path] for path in chosen.baseline], "errors") if chosen.baseline else {}
    others = [path for path in runs if path not in chosen.baseline]
    lines = [summarise(runs, figures, group, {}) for group in group_seeds(runs, chosen.baseline)]
    lines += [summarise(runs, figures, group, first) for group in group_seeds(runs, others)]
    sys.stdout.write(format_markdown(lines))
    write_json(chosen.json, {str(path): rows for path, rows in figures.items()})


if __name__ == "__main__":
    main()
