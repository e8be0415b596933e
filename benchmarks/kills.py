"""Kill -9 `nmpm simulate` and `nmpm fit` at random moments, go on, and compare with uninterrupted runs.

python benchmarks/kills.py --rounds 20

A round starts a tiny run in a new folder, kills its process at a moment drawn uniformly from the duration of an
uninterrupted run, and runs the command again until it ends by itself; a fit goes on by `nmpm fit --resume` where there
is a last checkpoint, and starts over where there is none. Then all files of a dataset must have the same bytes, the
best and last checkpoints of a fit the same weights, and its report the same figures, as those of the uninterrupted run.
Kills that come too late are drawn again. Processes are forked after the imports, so that no kill falls into those.
The exit status is 1 if a round differs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import torch

from nmpm.cli import main as main_of_nmpm

SIMULATE = (
    *("simulate", "goop", "--train", "6", "--valid", "1", "--test", "1", "--frames", "80"),
    *("--workers", "1", "--out"),
)
FIT = (
    *("fit", "--config", "goop.yaml", "--trainer.max_steps", "60", "--trainer.max_time", "null"),
    *("--trainer.val_check_interval", "20", "--resume.every_n_train_steps", "5", "--data.batch_size", "2"),
    *("--model.cells", "16", "--model.unroll", "1", "--model.processor.width", "4", "--trainer.accelerator", "cpu"),
    *("--trainer.precision", "32-true", "--trainer.enable_progress_bar", "false", "--data.path"),
)


@dataclass(frozen=True)
class Task:
    """A command that goes on after a kill.

    Args:
        command: Given its folder; asked again for each start.
        fingerprint: Of what it has made in a folder.
        progress: Whether it has left something in a folder to go on from.
    """

    command: Callable[[Path], Sequence[str]]
    fingerprint: Callable[[Path], str]
    progress: Callable[[Path], bool]


def main() -> None:
    """Run the rounds and print the totals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="kills of each command (default: 20)")
    parser.add_argument("--tasks", nargs="+", choices=["simulate", "fit"], default=["simulate", "fit"])
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: 0)")
    chosen = parser.parse_args()
    draw = random.Random(chosen.seed)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        data = root / "data"
        run(simulation().command(data))
        tasks = {"simulate": simulation(), "fit": training(data)}
        same = [kill_rounds(name, tasks[name], root, chosen.rounds, draw) for name in chosen.tasks]
    raise SystemExit(0 if all(same) else 1)


def simulation() -> Task:
    """Simulates a dataset."""
    return Task(
        lambda out: [*SIMULATE, str(out)],
        lambda out: digest(path.name.encode() + path.read_bytes() for path in sorted(out.glob("*.*"))),
        lambda out: any(out.rglob("*.npz")) or any(out.glob("*.h5")),
    )


def training(data: Path) -> Task:
    """Trains on a dataset."""

    def command(out: Path) -> list[str]:
        if last(out).is_file():
            return ["fit", "--resume", str(out)]
        return [*FIT, str(data), "--trainer.default_root_dir", str(out)]

    return Task(command, lambda out: digest([*weights(out), figures(out)]), lambda out: last(out).is_file())


def kill_rounds(name: str, task: Task, root: Path, rounds: int, draw: random.Random) -> bool:
    """Kill a command in several new folders; whether all ended like an uninterrupted one."""
    begin = time.monotonic()
    run(task.command(root / f"{name}-whole"))
    duration, expected = time.monotonic() - begin, task.fingerprint(root / f"{name}-whole")
    kills = too_late = with_progress = same = 0
    while kills < rounds:
        out = root / f"{name}-{kills + too_late}"
        if not killed_after(draw.uniform(0, duration), task.command(out)):
            too_late += 1
            continue
        kills += 1
        with_progress += task.progress(out)
        run(task.command(out))
        same += task.fingerprint(out) == expected
        sys.stderr.write(f"\r{name}: {kills} kills, {same} same")
    sys.stderr.write("\n")
    sys.stdout.write(
        f"{name}: {rounds} kills within {duration:.0f} s, {with_progress} of them after something to go on from was"
        f" written ({too_late} came too late and do not count); {same} ended like the uninterrupted run.\n"
    )
    return same == rounds


def killed_after(seconds: float, words: Sequence[str]) -> bool:
    """Start nmpm and kill it; False if it had ended before."""
    process = start(words)
    process.join(seconds)
    process.kill()
    process.join()
    return process.exitcode == -signal.SIGKILL


def run(words: Sequence[str]) -> None:
    """Run nmpm to its end."""
    process = start(words)
    process.join()
    if process.exitcode:
        raise SystemExit(f"nmpm {' '.join(words)} ended with status {process.exitcode}.")


def start(words: Sequence[str]) -> ForkServerProcess:
    """A process of nmpm, in which its modules are imported already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["nmpm.cli.run_training", "nmpm.data.simulation"])
    process = context.Process(target=run_silently, args=(list(words),))
    process.start()
    return process


def run_silently(words: list[str]) -> None:
    """Run nmpm in this process and exit with its status; nothing is shown."""
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        status = main_of_nmpm(words)
    raise SystemExit(status)


def last(out: Path) -> Path:
    """The checkpoint that a training goes on from."""
    return out / "checkpoints" / "last.ckpt"


def weights(out: Path) -> list[bytes]:
    """All weights of the best and the last checkpoint."""
    states = [torch.load(out / "checkpoints" / f"{name}.ckpt", weights_only=True)["state_dict"] for name in
              ("best", "last")]  # fmt: skip
    return [values.numpy().tobytes() for state in states for values in state.values()]


def figures(out: Path) -> bytes:
    """All figures of the report but times."""
    report = json.loads((out / "report.json").read_text())
    del report["training"]["seconds"]
    return json.dumps(report | {"curve": [errors for _, *errors in report["curve"]]}).encode()


def digest(parts: Iterable[bytes]) -> str:
    """SHA-256 of byte strings in order."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part)
    return total.hexdigest()


if __name__ == "__main__":
    main()
