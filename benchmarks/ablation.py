"""Variants of a recipe at equal training time: what each costs, and how far its rollouts are off.

python benchmarks/ablation.py benchmarks/sweeps/parts.yaml --minutes 10 --jobs 2 --out runs/parts
python benchmarks/ablation.py benchmarks/sweeps/parts.yaml --out runs/parts --table      print what is there

A sweep names a shipped configuration and, for each variant, what differs from it. First the time of a training step is
measured for all variants, in turns, one thread each; that and the minutes give the number of steps, so that whatever
else the machine does meanwhile changes nothing. Then each variant is trained and tested by `nmpm fit`. What is finished
is kept: the same call goes on after an interruption.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf
from torch.utils.flop_counter import FlopCounterMode

from nmpm._support.atomic import replacing
from nmpm._support.plain_data import to_tuples
from nmpm._support.shipped import find_config
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator.calibration import calibrate
from nmpm.particles import Window
from nmpm.training import EmulatorModule

_ROUNDS, _WARM_UP = 7, 2
_PARTS = 100
_COLUMNS = ("parameters", "gflop", "call_ms", "steps_per_s", "memory_mb", "steps", "mse@32", "mse")


@dataclass(frozen=True)
class Sweep:
    """A file of variants.

    Args:
        config: The shipped configuration that they differ from.
        common: What differs from it in all of them.
        variants: What differs from that, by name.
    """

    config: str
    common: Mapping[str, Any]
    variants: Mapping[str, Mapping[str, Any]]

    @classmethod
    def read(cls, path: Path) -> Sweep:
        """The sweep in a YAML file with `config`, `variants` and perhaps `common`."""
        plain = yaml.safe_load(path.read_text(encoding="utf-8"))
        return cls(plain["config"], plain.get("common") or {}, {k: v or {} for k, v in plain["variants"].items()})

    def whole(self, name: str) -> dict[str, Any]:
        """A variant's configuration."""
        layers = [OmegaConf.load(find_config(self.config)), *self.overlays(name)]
        whole = OmegaConf.to_container(OmegaConf.merge(*layers), resolve=True)
        # What a part is replaced by takes none of the arguments of what it replaces.
        for part, spec in self._replaced(name).items():
            whole["model"][part] = spec  # type: ignore[index,call-overload]
        return dict(whole)  # type: ignore[arg-type]

    def overlays(self, name: str) -> list[Any]:
        """What differs, layer by layer."""
        return [OmegaConf.create(dict(layer)) for layer in (self.common, self.variants[name])]

    def _replaced(self, name: str) -> dict[str, Any]:
        model = self.variants[name].get("model", {})
        return {part: spec for part, spec in model.items() if isinstance(spec, Mapping) and "class_path" in spec}


def module_of(config: Mapping[str, Any], scene: Any) -> EmulatorModule:
    """The untrained model of a configuration."""
    model = {key: value for key, value in config["model"].items() if key not in ("optimizer", "schedule")}
    parts = {
        key: _made(value) if isinstance(value, Mapping) and "class_path" in value else value
        for key, value in model.items()
    }
    torch.manual_seed(0)
    return EmulatorModule(scene, **parts)


def _made(spec: Mapping[str, Any]) -> Any:
    """The object of a class path and arguments, as the command line makes it."""
    arguments = {key: to_tuples(value) for key, value in (spec.get("init_args") or {}).items()}
    return _named(spec["class_path"])(**arguments)


def _named(path: str) -> Any:
    """What is called so, e.g. "torch.optim.Adam"."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


class Probe:
    """One variant, made to step and roll."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        options = dict(config["data"]) | {"horizon": config["model"]["frames"] * config["model"]["unroll"]}
        self.data = TrajectoryDataModule(**options)
        self.data.setup("fit")
        self.window: Window = next(iter(self.data.train_dataloader()))
        self.module = module_of(config, self.data.scene)
        calibrate(self.module.emulator, [self.window])
        # Bundles that grow: how often each number of them comes in a training.
        self.shares = Counter(self.module.bundles((part + 0.5) / _PARTS) for part in range(_PARTS))
        self.module.unroll_growth = 0.0
        optimizer = config["model"]["optimizer"]
        self.optimizer = _named(optimizer["class_path"])(self.module.parameters(), **optimizer.get("init_args", {}))

    def step(self) -> float:
        """Seconds of a training step, on the average over a training."""
        return sum(share / _PARTS * self._step(bundles) for bundles, share in self.shares.items())

    def _step(self, bundles: int) -> float:
        self.module.unroll = bundles
        start = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16):
            loss = self.module.training_step(self.window, 0)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.module.parameters(), 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()
        return time.perf_counter() - start

    @torch.no_grad()
    def call(self) -> float:
        """Seconds of a call at batch 1: the next m frames of one scene."""
        emulator = self.module.emulator.eval()
        state = self.window.initial.scenes(slice(1))
        context = emulator.context(state)
        start = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16):
            emulator(state, context)
        seconds = time.perf_counter() - start
        self.module.train()
        return seconds

    def costs(self) -> dict[str, float]:
        """Parameters, and multiplications and additions of the network per scene and call, in 10⁹."""
        emulator = self.module.emulator
        grid = torch.zeros(1, len(self.data.scene.input_channels), *emulator.grid.shape)
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            emulator.processor(grid)
        return {
            "parameters": sum(p.numel() for p in emulator.parameters()),
            "gflop": counter.get_total_flops() / 1e9,
        }


def measured(sweep: Sweep, names: list[str]) -> dict[str, dict[str, float]]:
    """What each variant costs, timed in turns."""
    probes = {name: Probe(sweep.whole(name)) for name in names}
    steps: dict[str, list[float]] = {name: [] for name in names}
    calls: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(_ROUNDS + _WARM_UP):
        for name, probe in probes.items():
            step, call = probe.step(), probe.call()
            if turn >= _WARM_UP:
                steps[name].append(step)
                calls[name].append(call)
    return {
        name: probe.costs()
        | {"steps_per_s": 1 / statistics.median(steps[name]), "call_ms": 1e3 * statistics.median(calls[name])}
        for name, probe in probes.items()
    }


def trained(sweep: Sweep, name: str, steps: int, folder: Path) -> dict[str, float]:
    """Errors of a variant after so many steps, and the memory that training took."""
    run = folder / name
    run.mkdir(parents=True, exist_ok=True)
    config = sweep.whole(name)
    config["trainer"] |= {
        "max_steps": steps,
        "max_time": None,
        "val_check_interval": max(1, steps // 4),
        "default_root_dir": str(run),
        "enable_progress_bar": False,
    }
    (run / "variant.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    words = [sys.executable, "-m", "nmpm", "fit", "--config", str(run / "variant.yaml")]
    if (run / "checkpoints" / "last.ckpt").exists():
        words += ["--ckpt_path", "last"]
    with (run / "log.txt").open("a", encoding="utf-8") as log:
        child = subprocess.Popen(words, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})  # noqa: S603
        _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise RuntimeError(f"{name} failed; see {run / 'log.txt'}")
    report = json.loads((run / "report.json").read_text(encoding="utf-8"))
    errors = report["test"]
    return {"mse@32": 1e3 * errors["mse@32"], "mse": 1e3 * errors["mse"], "memory_mb": usage.ru_maxrss / 1024}


def table(results: Mapping[str, Mapping[str, float]]) -> str:
    """A line per variant, those with the least error first."""
    lines = [f"{'variant':<22}" + "".join(f"{column:>13}" for column in _COLUMNS)]
    for name, row in sorted(results.items(), key=lambda item: item[1].get("mse", float("inf"))):
        lines.append(f"{name:<22}" + "".join(f"{row[c]:>13.4g}" if c in row else f"{'–':>13}" for c in _COLUMNS))
    return "\n".join(lines)


def main() -> None:
    """Measure, train what is not trained yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sweep", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0, help="of training, one thread each (default: 10)")
    parser.add_argument("--jobs", type=int, default=1, help="variants trained at a time (default: 1)")
    parser.add_argument("--only", nargs="+", help="train these variants only")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs and of results.json")
    parser.add_argument("--table", action="store_true", help="train nothing, print what is there")
    chosen = parser.parse_args()
    sweep, path = Sweep.read(chosen.sweep), chosen.out / "results.json"
    results: dict[str, dict[str, float]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def keep() -> None:
        with replacing(path) as part:
            part.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")

    def finish(name: str) -> None:
        steps = max(20, round(60 * chosen.minutes * results[name]["steps_per_s"] / 20) * 20)
        results[name] |= {"steps": steps} | trained(sweep, name, steps, chosen.out)
        keep()
        sys.stdout.write(f"{name}: MSE {results[name]['mse']:.3g} ×10⁻³ after {steps} steps\n")
        sys.stdout.flush()

    if not chosen.table:
        names = chosen.only or list(sweep.variants)
        torch.set_num_threads(1)
        if not all("steps_per_s" in results.get(name, {}) for name in sweep.variants):
            results |= {n: results.get(n, {}) | costs for n, costs in measured(sweep, list(sweep.variants)).items()}
            keep()
        with ThreadPoolExecutor(chosen.jobs) as pool:
            list(pool.map(finish, [name for name in names if "mse" not in results[name]]))
    sys.stdout.write(table(results) + "\n")


if __name__ == "__main__":
    main()
