"""Train variants of a configuration for equal time: cost of each, and the errors of its rollouts.

python benchmarks/ablation.py benchmarks/sweeps/parts.yaml --minutes 10 --jobs 2 --out runs/parts
python benchmarks/ablation.py benchmarks/sweeps/parts.yaml --out runs/parts --table      print finished results

A sweep names a shipped configuration and the changes that each variant makes to it. First the time of a training step
is measured for all variants, alternating, one thread each. That time and the minutes give each variant's number of
steps, so that other load on the machine during training does not change the results. Then `nmpm fit` trains and tests
each variant. Results are saved as they come: the same command continues after an interruption.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Lock
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf
from timing import (
    WARM_UP,
    add_device_option,
    make_parser,
    peak_bytes,
    time_run,
    write_json,
)
from torch.utils.flop_counter import FlopCounterMode

from nmpm._support.plain_data import to_tuples
from nmpm._support.shipped import find_config
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator.calibration import calibrate
from nmpm.particles import Window
from nmpm.scene import Scene
from nmpm.training import EmulatorModule

_ROUNDS = 7
_PROGRESS_SAMPLES = 100
_COLUMNS = ("parameters", "gflop", "call_ms", "steps_per_s", "memory_mb", "steps", "mse@32", "mse")


@dataclass(frozen=True)
class Sweep:
    """Variants of a shipped configuration.

    Args:
        config: The name of the configuration.
        common: Changes in all variants.
        variants: Further changes, by the variant's name.
    """

    config: str
    common: Mapping[str, Any]
    variants: Mapping[str, Mapping[str, Any]]

    @classmethod
    def read(cls, path: Path) -> Sweep:
        """Read a YAML file with `config`, `variants` and optionally `common`."""
        plain = yaml.safe_load(path.read_text(encoding="utf-8"))
        return cls(plain["config"], plain.get("common") or {}, {k: v or {} for k, v in plain["variants"].items()})

    def config_of(self, name: str) -> dict[str, Any]:
        """A variant's complete configuration."""
        layers = [OmegaConf.load(find_config(self.config)), *self._changes(name)]
        config = OmegaConf.to_container(OmegaConf.merge(*layers), resolve=True)
        # A replaced part must not inherit the arguments of the old one.
        for part, spec in self._replaced(name).items():
            config["model"][part] = spec  # type: ignore[index,call-overload]
        return dict(config)  # type: ignore[arg-type]

    def _changes(self, name: str) -> list[Any]:
        return [OmegaConf.create(dict(layer)) for layer in (self.common, self.variants[name])]

    def _replaced(self, name: str) -> dict[str, Any]:
        model = self.variants[name].get("model", {})
        return {part: spec for part, spec in model.items() if isinstance(spec, Mapping) and "class_path" in spec}


def build_module(config: Mapping[str, Any], scene: Scene) -> EmulatorModule:
    """Build the untrained model of a configuration."""
    model = {key: value for key, value in config["model"].items() if key not in ("optimizer", "schedule")}
    parts = {
        key: _instantiate(value) if isinstance(value, Mapping) and "class_path" in value else value
        for key, value in model.items()
    }
    torch.manual_seed(0)
    return EmulatorModule(scene, **parts)


def _instantiate(spec: Mapping[str, Any]) -> Any:
    """Build the object of a class path and arguments, as the command line does."""
    arguments = {key: to_tuples(value) for key, value in (spec.get("init_args") or {}).items()}
    return _import(spec["class_path"])(**arguments)


def _import(path: str) -> Any:
    """Import a class by its path, e.g. "torch.optim.Adam"."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


class VariantTimer:
    """A variant on one batch of its data, to be timed.

    Args:
        config: Its complete configuration.
        device: Where it computes.
    """

    def __init__(self, config: Mapping[str, Any], device: torch.device) -> None:
        options = dict(config["data"]) | {"horizon": config["model"]["frames"] * config["model"]["unroll"]}
        self.data = TrajectoryDataModule(**options)
        self.data.setup("fit")
        window: Window = next(iter(self.data.train_dataloader()))
        self.module = build_module(config, self.data.scene)
        calibrate(self.module.emulator, [window])
        self.module, self.window, self.device = self.module.to(device), window.to(device), device
        # With `unroll_growth`, how often each number of bundles is unrolled in a training.
        samples = ((sample + 0.5) / _PROGRESS_SAMPLES for sample in range(_PROGRESS_SAMPLES))
        self.shares = Counter(map(self.module.bundles, samples))
        self.module.unroll_growth = 0.0
        optimizer = config["model"]["optimizer"]
        self.optimizer = _import(optimizer["class_path"])(self.module.parameters(), **optimizer.get("init_args", {}))

    def time_step(self) -> float:
        """Seconds of a training step, averaged over the numbers of bundles in a training."""
        return sum(share / _PROGRESS_SAMPLES * self._time_unrolled(bundles) for bundles, share in self.shares.items())

    def _time_unrolled(self, bundles: int) -> float:
        self.module.unroll = bundles
        return time_run(self.step)

    def step(self) -> None:
        """One training step."""
        with torch.autocast(self.device.type, torch.bfloat16):
            loss = self.module.training_step(self.window, 0)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.module.parameters(), 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()

    @torch.no_grad()
    def time_call(self) -> float:
        """Seconds of a call at batch 1: the next m frames of one scene."""
        emulator = self.module.emulator.eval()
        state = self.window.initial.scenes(slice(1))
        context = emulator.context(state)
        with torch.autocast(self.device.type, torch.bfloat16):
            seconds = time_run(lambda: emulator(state, context))
        self.module.train()
        return seconds

    def count_costs(self) -> dict[str, float]:
        """Parameters, 10⁹ floating-point operations of the network per scene and call, and on a GPU MB per step."""
        emulator = self.module.emulator
        grid = torch.zeros(1, len(self.data.scene.input_channels), *emulator.grid.shape, device=self.device)
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            emulator.processor(grid)
        costs = {
            "parameters": sum(p.numel() for p in emulator.parameters()),
            "gflop": counter.get_total_flops() / 1e9,
        }
        return costs if self.device.type == "cpu" else costs | {"memory_mb": peak_bytes(self.step, self.device) / 2**20}


def measure_costs(sweep: Sweep, names: list[str], device: torch.device) -> dict[str, dict[str, float]]:
    """Time and size of each variant, timed alternately."""
    timers = {name: VariantTimer(sweep.config_of(name), device) for name in names}
    steps: dict[str, list[float]] = {name: [] for name in names}
    calls: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(_ROUNDS + WARM_UP):
        for name, timer in timers.items():
            step, call = timer.time_step(), timer.time_call()
            if turn >= WARM_UP:
                steps[name].append(step)
                calls[name].append(call)
    return {
        name: timer.count_costs()
        | {"steps_per_s": 1 / statistics.median(steps[name]), "call_ms": 1e3 * statistics.median(calls[name])}
        for name, timer in timers.items()
    }


def train_variant(sweep: Sweep, name: str, steps: int, folder: Path, device: torch.device) -> dict[str, float]:
    """Train a variant, and return its test errors; on the CPU also the memory that training took."""
    run = folder / name
    run.mkdir(parents=True, exist_ok=True)
    config = sweep.config_of(name)
    config["trainer"] |= {
        "max_steps": steps,
        "max_time": None,
        "val_check_interval": max(1, steps // 4),
        "default_root_dir": str(run),
        "enable_progress_bar": False,
        "accelerator": device.type,
        "devices": 1,
    }
    (run / "variant.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    words = [sys.executable, "-m", "nmpm", "fit", "--config", str(run / "variant.yaml")]
    if (run / "checkpoints" / "last.ckpt").exists():
        words += ["--ckpt_path", "last"]
    with (run / "log.txt").open("a", encoding="utf-8") as log:
        child = subprocess.Popen(words, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})
        _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise RuntimeError(f"{name} failed; see {run / 'log.txt'}")
    report = json.loads((run / "report.json").read_text(encoding="utf-8"))
    errors = {"mse@32": 1e3 * report["test"]["mse@32"], "mse": 1e3 * report["test"]["mse"]}
    return errors | {"memory_mb": usage.ru_maxrss / 1024} if device.type == "cpu" else errors


def format_table(results: Mapping[str, Mapping[str, float]]) -> str:
    """A line per variant, the least error first."""
    lines = [f"{'variant':<22}" + "".join(f"{column:>13}" for column in _COLUMNS)]
    for name, row in sorted(results.items(), key=lambda item: item[1].get("mse", float("inf"))):
        lines.append(f"{name:<22}" + "".join(f"{row[c]:>13.4g}" if c in row else f"{'–':>13}" for c in _COLUMNS))
    return "\n".join(lines)


class Results:
    """Costs and errors by variant, saved to `results.json` at every change.

    Args:
        path: The file; it is read if it exists.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._lock = path, Lock()
        self.rows: dict[str, dict[str, float]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def update(self, rows: Mapping[str, Mapping[str, float]]) -> None:
        """Add figures to variants; safe to call from several threads."""
        with self._lock:
            self.rows |= {name: self.rows.get(name, {}) | dict(row) for name, row in rows.items()}
            write_json(self.path, self.rows)


def run_sweep(sweep: Sweep, results: Results, chosen: argparse.Namespace) -> None:
    """Measure and train whatever has no result yet."""
    torch.set_num_threads(1)
    names = list(sweep.variants)
    if not all("steps_per_s" in results.rows.get(name, {}) for name in names):
        results.update(measure_costs(sweep, names, chosen.device))

    def train(name: str) -> None:
        steps = max(20, round(60 * chosen.minutes * results.rows[name]["steps_per_s"] / 20) * 20)
        results.update({name: {"steps": steps} | train_variant(sweep, name, steps, chosen.out, chosen.device)})
        sys.stdout.write(f"{name}: MSE {results.rows[name]['mse']:.3g} ×10⁻³ after {steps} steps\n")
        sys.stdout.flush()

    with ThreadPoolExecutor(chosen.jobs) as pool:
        list(pool.map(train, [name for name in chosen.only or names if "mse" not in results.rows[name]]))


def main() -> None:
    """Measure, train what is not trained yet, and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("sweep", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0, help="of training, one thread each (default: 10)")
    parser.add_argument("--jobs", type=int, default=1, help="variants trained at a time (default: 1)")
    parser.add_argument("--only", nargs="+", help="train these variants only")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs and of results.json")
    parser.add_argument("--table", action="store_true", help="train nothing, print finished results")
    add_device_option(parser)
    chosen = parser.parse_args()
    results = Results(chosen.out / "results.json")
    if not chosen.table:
        run_sweep(Sweep.read(chosen.sweep), results, chosen)
    sys.stdout.write(format_table(results.rows) + "\n")


if __name__ == "__main__":
    main()
