"""Train the models of queue.yaml with `nmpm fit`, test them and make their entries.

    python zoo/train.py                            # all of queue.yaml, in its order
    python zoo/train.py goop wbcsph --threads 1    # once per core, or with --device cuda:0, cuda:1 once per GPU
    python zoo/train.py waterdrop --data waterdrop=FOLDER   # with recorded data
    python zoo/train.py --dry-run                  # print the commands

Stage k of a model is a run of its own in RUNS/NAME/k, which starts from the best weights of the stage before. After an
interruption the same command goes on from the last checkpoint. Several of these processes share the work: each takes
models that no other one has.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout

HERE = Path(__file__).parent
VALIDATIONS = 30
"""Validations in a stage: points of the curve of its chart."""
INTERRUPTED = 130
"""Exit status of `nmpm` after Ctrl-C or SIGTERM."""
Model = dict[str, Any]


def parse(words: list[str] | None = None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="models to train (default: all of the queue)")
    parser.add_argument("--queue", type=Path, default=HERE / "queue.yaml", help="what to train (zoo/queue.yaml)")
    parser.add_argument("--runs", type=Path, default=Path("runs/zoo"), help="folder of the runs (default: runs/zoo)")
    parser.add_argument("--root", type=Path, help="folder of the new entries (default: RUNS/entries)")
    parser.add_argument("--data", action="append", default=[], metavar="NAME=FOLDER", help="recorded data; repeatable")
    parser.add_argument("--threads", type=int, help="processor threads of this process (default: all)")
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda, cuda:1, mps")
    parser.add_argument("--dry-run", action="store_true", help="print the commands that are left, and run none")
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> int:
    """Train what is left; 0 if nothing failed, 130 after an interruption."""
    options = parse(words)
    if options.threads is not None:  # before numerical libraries are imported
        for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
            os.environ[variable] = str(options.threads)
    failed = []
    for model in select(yaml.safe_load(options.queue.read_text(encoding="utf-8")), options):
        folder = options.runs / model["name"]
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(folder / ".lock", blocking=False):
                status = train(model, folder, options)
        except Timeout:  # another process has it
            continue
        if status == INTERRUPTED:
            return INTERRUPTED
        if status:
            failed.append(model["name"])
    sys.stdout.write(f"Failed: {', '.join(failed) or 'none'}.\n")
    return 1 if failed else 0


def select(queue: list[Model], options: argparse.Namespace) -> list[Model]:
    """The models that are asked for, with the folders of recorded data."""
    data = dict(entry.split("=", 1) for entry in options.data)
    unknown = {*options.names, *data} - {model["name"] for model in queue}
    if unknown:
        sys.exit(f"error: {options.queue} has no {', '.join(sorted(unknown))}.")
    models = [model for model in queue if not options.names or model["name"] in options.names]
    return [model | {"data": data.get(model["name"])} for model in models]


def train(model: Model, folder: Path, options: argparse.Namespace) -> int:
    """Run the commands of a model that are left; the status of the first that fails."""
    for command in commands(model, folder, options):
        sys.stdout.write(f"nmpm {shlex.join(command)}\n")
        if options.dry_run:
            continue
        from nmpm.cli import main as nmpm

        if status := nmpm(command):
            return int(status)
        if command[0] == "test":
            add_up_stages([folder / str(number) for number, _ in enumerate(model["stages"], 1)])
    return 0


def commands(model: Model, folder: Path, options: argparse.Namespace) -> Iterator[list[str]]:
    """The words of `nmpm` for what a model lacks: its stages, a float32 test of the last one, its entry."""
    root = options.root or options.runs / "entries"
    if (root / model["name"] / "card.yaml").is_file():
        return
    runs = [folder / str(number) for number, _ in enumerate(model["stages"], 1)]
    for run, former, stage in zip(runs, [None, *runs], model["stages"], strict=False):
        if not (run / "report.json").is_file():
            yield fit(model, stage, run, former) + device(options.device)
    yield ["test", str(runs[-1]), "--trainer.precision", "32-true"]
    yield ["zoo", "add", str(runs[-1]), model["name"], "--root", str(root), "--about", model.get("about", "")]
    yield ["zoo", "refresh", model["name"], "--root", str(root), "--measure", "speed"]


def fit(model: Model, stage: Model, run: Path, former: Path | None) -> list[str]:
    """The words of `nmpm fit` that begin a stage or go on with it."""
    if (run / "checkpoints" / "last.ckpt").is_file():
        return ["fit", "--resume", str(run)]
    # Time alone ends a stage, so that the learning rate comes down with it.
    values = {
        "trainer.default_root_dir": str(run),
        "trainer.max_steps": -1,
        "trainer.max_time": duration(3600 * stage["hours"]),
        "trainer.val_check_interval": duration(3600 * stage["hours"] / VALIDATIONS),
        **model.get("options", {}),
        **stage.get("options", {}),
    }
    if former is not None:
        values["start_from"] = str(former / "checkpoints" / "best.ckpt")
    if model["data"] is not None:
        values.setdefault("data.path", model["data"])
    words = ["fit", "--config", model["config"]]
    for key, value in values.items():
        words += [f"--{key}", value if isinstance(value, str) else json.dumps(value)]
    return words


def device(name: str) -> list[str]:
    """The words of `nmpm fit` for a device."""
    kind, _, index = name.partition(":")
    return ["--trainer.accelerator", kind, "--trainer.devices", f"[{index}]" if index else "1"]


def duration(seconds: float) -> str:
    """Seconds as DD:HH:MM:SS, at least one."""
    whole = timedelta(seconds=max(1, round(seconds)))
    hours, rest = divmod(whole.seconds, 3600)
    return f"{whole.days:02}:{hours:02}:{rest // 60:02}:{rest % 60:02}"


def add_up_stages(runs: list[Path]) -> None:
    """Write to the last stage's report what all stages took, as its entry states it."""
    *former, last = [json.loads((run / "report.json").read_text(encoding="utf-8")) for run in runs]
    for report in reversed(former):
        seconds, steps = report["training"]["seconds"], report["training"]["steps"]
        last["curve"] = report["curve"] + [[s + seconds, n + steps, *errors] for s, n, *errors in last["curve"]]
        last["training"] |= {
            "seconds": round(last["training"]["seconds"] + seconds, 1),
            "steps": last["training"]["steps"] + steps,
        }
    (runs[-1] / "report.json").write_text(json.dumps(last, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
