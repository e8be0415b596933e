"""Ways to fine-tune a model on foreign data: errors of rollouts against steps and trajectories, by method.

python benchmarks/fine_tuning.py DATA --out runs/tuning --jobs 2 --samples goo --counts 1,10 --methods full,last
python benchmarks/fine_tuning.py DATA --out runs/tuning --table     print what is finished

DATA is a folder with a dataset for each sample, such as DATA/grains; `goo` is simulated there where it is missing. Each
cell, a sample with so many training trajectories, a method and a seed, is a process of one thread that writes a file
with its errors on the valid and the test split at some steps; those that are there already are skipped.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import lightning
import torch
from timing import make_parser, write_json
from torch import Tensor, nn
from torch.nn.utils import parametrize

import nmpm
from nmpm import EmulatorModule, TrajectoryDataModule, Zoo
from nmpm.emulator import Emulator, Prescribed, RolloutOptions, predict_rollout
from nmpm.emulator.calibration import calibrate
from nmpm.evaluation.comparison import Comparison
from nmpm.metrics import MSE, overall_error
from nmpm.optimizers import SOAP
from nmpm.particles import Window
from nmpm.sim import load_preset, preset_from_dict

LOOKS = (20, 50, 100, 150, 200, 250, 300, 400, 600, 800)
"""Steps after which errors are measured, beside the start and the end."""
RANK = 4
HORIZON = 16
"""Frames from which on errors count in the choice of the best weights."""


@dataclass(frozen=True)
class Sample:
    """Foreign data, and the model to start from.

    Args:
        start: Name in the zoo.
        materials: The model's by the data's name.
    """

    start: str
    materials: Mapping[str, str] = field(default_factory=dict)


SAMPLES = {
    "goo": Sample("goop"),
    "grains": Sample("sandramps", {"type1": "sand", "type2": "sand"}),
    "blocks": Sample("multimaterial", {"type0": "water", "type1": "goop", "type2": "sand"}),
    "sph": Sample("waterdrop3d", {"particles": "water"}),
    "elements": Sample("sandramps"),
}


# Methods


class LowRank(nn.Module):
    """Adds a matrix of low rank to a layer's weights, zero at first (Hu et al., arXiv 2106.09685)."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        columns = weight[0].numel()
        self.down = nn.Parameter(torch.randn(RANK, columns) / columns**0.5)
        self.up = nn.Parameter(torch.zeros(len(weight), RANK))

    def forward(self, weight: Tensor) -> Tensor:
        return weight + (self.up @ self.down).view(weight.shape)


def _everything(_module: EmulatorModule, _windows: list[Window]) -> None:
    """All weights."""


def _recalibrated(module: EmulatorModule, windows: list[Window]) -> None:
    """All weights, from statistics of the new data."""
    calibrate(module.emulator, windows)


def _last_layers(module: EmulatorModule, _windows: list[Window]) -> None:
    """The perceptrons at the network's end alone."""
    module.emulator.requires_grad_(False)
    module.emulator.processor.decoders.requires_grad_(True)


def _low_rank(module: EmulatorModule, _windows: list[Window]) -> None:
    """Low-rank changes of the convolutions alone."""
    module.emulator.requires_grad_(False)
    for layer in list(module.emulator.processor.modules()):
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d | nn.Conv3d | nn.ConvTranspose3d):
            parametrize.register_parametrization(layer, "weight", LowRank(layer.weight))


def _from_nothing(module: EmulatorModule, windows: list[Window]) -> None:
    """Random weights in the same form, and statistics of the new data."""
    module.emulator.load_state_dict(module.emulator.recipe.build().state_dict())
    calibrate(module.emulator, windows)


@dataclass(frozen=True)
class Method:
    """What learns, and how fast.

    Args:
        prepare: Changes a module with the start's weights, given windows of the new data.
        rate: Learning rate of SOAP.
        unroll: Bundles that a step predicts.
        steps: At most so many; 0 leaves it at what `prepare` does.
        options: Further arguments of the module.
    """

    prepare: Callable[[EmulatorModule, list[Window]], None]
    rate: float
    unroll: int = 2
    steps: int | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


METHODS = {
    "full": Method(_everything, 2e-3),
    "half": Method(_everything, 1e-3),
    "quarter": Method(_everything, 5e-4),
    "double": Method(_everything, 4e-3),
    "short": Method(_everything, 2e-3, unroll=1),
    "long": Method(_everything, 2e-3, unroll=4),
    "augmented": Method(_everything, 2e-3, options={"jitter": 0.35, "mirror": (0,)}),
    "recalibrated": Method(_recalibrated, 2e-3),
    "last": Method(_last_layers, 4e-3),
    "low-rank": Method(_low_rank, 4e-3),
    "statistics": Method(_recalibrated, 1.0, steps=0),
    "nothing": Method(_from_nothing, 6e-3),
}
UNCHANGED = frozenset(METHODS) - {"recalibrated", "statistics", "nothing"}
"""Methods before whose first step the model is as it was."""


# A cell


@dataclass(frozen=True)
class Cell:
    """One training.

    Args:
        start: The model that it starts from.
        sample, count, method, seed: Of `SAMPLES` and `METHODS`; training trajectories.
        steps: Of the training.
    """

    start: str
    sample: str
    count: int
    method: str
    seed: int
    steps: int

    @property
    def name(self) -> str:
        return f"{self.start}-{self.sample}-{self.count}-{self.method}-{self.seed}"


def run_cell(cell: Cell, data: Path, out: Path) -> None:
    """Train as a cell says, and write its errors."""
    torch.set_num_threads(1)
    torch.manual_seed(cell.seed)
    method = METHODS[cell.method]
    steps = cell.steps if method.steps is None else method.steps
    folder = first_trajectories(data / cell.sample, cell.count, out / "data" / f"{cell.sample}-{cell.count}")
    module, loader = prepare(cell, folder)
    curve = Curve(steps, loader.val_dataloader(), loader.test_dataloader())
    curve.look(module, 0)
    if steps:
        trainer = lightning.Trainer(
            max_steps=steps,
            callbacks=[curve],
            gradient_clip_val=1.0,
            limit_val_batches=0,
            accelerator="cpu",
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        trainer.fit(module, loader)
    learning = sum(values.numel() for values in module.parameters() if values.requires_grad)
    result = {**vars(cell), "learning": learning, "seconds": curve.seconds, "curve": curve.rows}
    write_json(out / "cells" / f"{cell.name}.json", result)


def prepare(cell: Cell, folder: Path) -> tuple[EmulatorModule, TrajectoryDataModule]:
    """The module that a cell trains, and its data."""
    method, start = METHODS[cell.method], Zoo.load(cell.start)
    data = TrajectoryDataModule(
        path=str(folder),
        horizon=start.emulator.frames * method.unroll,
        batch_size=4,
        emphasis=0.5,
        openings=0.3,
        seed=cell.seed,
    )
    start = start.fit_to(data, materials=SAMPLES[cell.sample].materials or None)
    data.reading = start.match.reading
    module = EmulatorModule.of(
        start.emulator,
        unroll=method.unroll,
        optimizer=lambda weights: SOAP([values for values in weights if values.requires_grad], lr=method.rate),
        schedule={"warmup": 20, "start": 0.1},
        seed=cell.seed,
        **method.options,
    )
    method.prepare(module, list(islice(data.train_dataloader(), 4)))
    return module, data


class Curve(lightning.Callback):
    """Errors on the valid and the test split during a training, and the seconds that its steps take."""

    def __init__(self, steps: int, valid: Iterable[Window], test: Iterable[Window]) -> None:
        self.steps, self.splits = steps, {"valid": list(valid), "test": list(test)}
        self.rows: list[dict[str, Any]] = []
        self.seconds, self._since = 0.0, 0.0

    def look(self, module: EmulatorModule, step: int) -> None:
        emulator = module.emulator.eval()
        errors = {split: rollout_errors(emulator, windows) for split, windows in self.splits.items()}
        self.rows.append({"step": step, "seconds": round(self.seconds, 2), **errors})
        module.train()

    def on_train_batch_start(self, *_: Any) -> None:
        self._since = time.process_time()

    def on_train_batch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any) -> None:
        self.seconds += time.process_time() - self._since
        if trainer.global_step in LOOKS or trainer.global_step == self.steps:
            self.look(module, trainer.global_step)  # type: ignore[arg-type]  # (an EmulatorModule)


@torch.no_grad()
def rollout_errors(emulator: Emulator, windows: Iterable[Window]) -> dict[str, float]:
    """Errors of full rollouts by name: the model's, of which "overall" chooses weights, and trivial predictors'."""
    errors = Comparison(emulator.scene, [MSE()], emulator.frames)
    for window in windows:
        predicted = predict_rollout(
            emulator, window.initial, window.target.shape[1], RolloutOptions(Prescribed.of(window))
        )
        errors.update(window, predicted.position, predicted.fields)
    values = errors.compute()
    return {name: float(value) for name, value in (values | {"overall": overall_error(values, HORIZON)}).items()}


# Data


def first_trajectories(source: Path, count: int, folder: Path) -> Path:
    """A dataset of the first `count` training trajectories of another, and all that it tests and validates on."""
    if not (folder / "metadata.json").is_file():
        part = folder.with_name(f"{folder.name}-{os.getpid()}")
        part.mkdir(parents=True)
        for split in ("valid", "test"):
            shutil.copy(source / f"{split}.h5", part)
        with h5py.File(source / "train.h5") as old, h5py.File(part / "train.h5", "w") as new:
            for name in islice(old, count):
                old.copy(name, new)
        shutil.copy(source / "metadata.json", part)
        try:
            part.rename(folder)
        except OSError:  # another cell was faster
            shutil.rmtree(part)
    return folder


def simulate_goo(folder: Path, counts: Mapping[str, int], frames: int = 120) -> None:
    """Goop of another stiffness, viscosity and particle size, in millimetres, at 250 Hz, in weaker gravity."""
    plain = load_preset("goop").with_frames(frames).to_dict()
    plain |= {"frame_dt": 0.004, "substeps": 10, "gravity": [0.0, -3.8], "cells": 40, "spacing": 0.0107}
    plain["materials"]["goop"] |= {"young": 2.0e5, "viscosity": 15.0, "yield_stress": 50.0}
    plain["blocks"] |= {"particles": [500, 700], "speed": 1.0}
    preset = preset_from_dict(plain)
    scene, seeds = preset.scene, itertools.count()
    runs = {split: [1e3 * preset.simulate(next(seeds)).position for _ in range(n)] for split, n in counts.items()}
    gravity, bounds = [1e3 * g for g in scene.gravity or ()], [[1e3 * x for x in side] for side in scene.bounds]
    nmpm.write_trajectories(folder, runs, dt=scene.dt, gravity=gravity, bounds=bounds, types={0: "goo"})


# Table


def table(cells: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Lines: errors as multiples of those of the model that the training starts with; medians over seeds."""
    yield f"{'':<44}{'zero-shot':>10}{'20':>7}{'100':>7}{'end':>7}{'kept':>7}{'worst':>7}{'steps':>7}{'s/step':>7}"
    groups: dict[tuple[str, str, int, str], list[Mapping[str, Any]]] = {}
    for cell in cells:
        groups.setdefault((cell["start"], cell["sample"], cell["count"], cell["method"]), []).append(cell)
    zero = {(name, sample): group[0]["curve"][0]["test"] for (name, sample, _, way), group in groups.items()
            if way in UNCHANGED}  # fmt: skip
    for (name, sample, count, method), group in sorted(groups.items()):
        start = zero.get((name, sample))
        if start is None:
            continue
        columns = [[_at(cell, 20), _at(cell, 100), _at(cell, None), _kept(cell)] for cell in group]
        ratios = [statistics.median(values) / start["overall"] for values in zip(*columns, strict=True)]
        worst = max(column[-1] for column in columns) / start["overall"]
        steps = group[0]["curve"][-1]["step"]
        pace = statistics.median(cell["seconds"] for cell in group) / max(steps, 1)
        shown = "".join(f"{ratio:>7.3f}" for ratio in (*ratios, worst))
        what = f"{name} {sample} {count} {method} ({len(group)})"
        yield f"{what:<44}{1e3 * start['overall']:>10.4g}{shown}{steps:>7}{pace:>7.2f}"
    for (name, sample), start in zero.items():
        trivial = ", ".join(f"{name} {start[f'{name}/mse'] / start['mse']:.3g}" for name in ("still", "free_fall"))
        yield f"{name} {sample}: full-rollout MSE zero-shot {1e3 * start['mse']:.4g} x 1e-3; times that: {trivial}"


def _at(cell: Mapping[str, Any], step: int | None) -> float:
    """The error on the test split after so many steps, or the last before; of the last for None."""
    rows = [row for row in cell["curve"] if step is None or row["step"] <= step]
    return float(rows[-1]["test"]["overall"])


def _kept(cell: Mapping[str, Any]) -> float:
    """The error on the test split of the weights with the least error on the valid split, the start's among them."""
    return float(min(cell["curve"], key=lambda row: row["valid"]["overall"])["test"]["overall"])


# Command line


def main() -> None:
    """Run or print the cells."""
    parser = make_parser(__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--start", help="model to start from (default: of each sample)")
    parser.add_argument("--samples", default="goo", help=f"of {', '.join(SAMPLES)}; default goo")
    parser.add_argument("--counts", default="1,3,10,30", help="training trajectories")
    parser.add_argument("--methods", default=",".join(METHODS), help="default: all")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time, a thread each")
    parser.add_argument("--table", action="store_true", help="print what is finished")
    parser.add_argument("--cell", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.cell:
        warnings.filterwarnings("ignore", module="lightning")
        run_cell(Cell(**json.loads(arguments.cell)), arguments.data, arguments.out)
        return
    if not arguments.table:
        run_all(arguments)
    finished = [json.loads(path.read_text()) for path in sorted((arguments.out / "cells").glob("*.json"))]
    sys.stdout.writelines(f"{line}\n" for line in table(finished))


def run_all(arguments: argparse.Namespace) -> None:
    """Run the cells that are not finished, a process each; first seeds first."""
    samples, methods = arguments.samples.split(","), arguments.methods.split(",")
    counts, seeds = (map(int, text.split(",")) for text in (arguments.counts, arguments.seeds))
    if "goo" in samples and not (arguments.data / "goo").is_dir():
        simulate_goo(arguments.data / "goo", {"train": 30, "valid": 2, "test": 4})
    every = itertools.product(seeds, list(counts), samples, methods)
    cells = [
        Cell(arguments.start or SAMPLES[sample].start, sample, count, method, seed, arguments.steps)
        for seed, count, sample, method in every
    ]
    waiting = [cell for cell in cells if not (arguments.out / "cells" / f"{cell.name}.json").is_file()]
    (arguments.out / "cells").mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(arguments.jobs) as pool:
        for cell, ended in zip(waiting, pool.map(lambda cell: _start(cell, arguments), waiting), strict=True):
            last = (ended.stderr.strip().splitlines() or [""])[-1]
            sys.stdout.write(f"{cell.name}: {'done' if not ended.returncode else last}\n")


def _start(cell: Cell, arguments: argparse.Namespace) -> subprocess.CompletedProcess[str]:
    words = [str(arguments.data), "--out", str(arguments.out), "--cell", json.dumps(vars(cell))]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, __file__, *words], env=environment, capture_output=True, text=True, check=False
    )


if __name__ == "__main__":
    main()
