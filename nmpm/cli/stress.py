"""`nmpm stress NAME`."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.evaluation.stress import Line, Size, Subject
    from nmpm.sim import Preset

DESCRIPTION = """Put a trained model through the extremes: long rollouts, fast and slow, many and few particles, other
boxes and grids, precision, sensitivity, obstacles it never saw, poisoned input. One line for each, pass or fail by a
stated invariant, with what was measured; errors are against the simulator that made its data, where there is one. Exits
with 1 if a line fails."""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["stress", "goop"]."""
    parser = argparse.ArgumentParser(prog="nmpm stress", description=DESCRIPTION)
    parser.add_argument("model", help="a model of the zoo, or a checkpoint: runs/goop/checkpoints/best.ckpt")
    parser.add_argument("--full", action="store_true", help="all of it, as zoo cards quote (default: reduced, minutes)")
    parser.add_argument("--preset", help="simulator of its scenes (default: of the zoo model's name; none if recorded)")
    parser.add_argument("--free", action="store_true", help="without the model's constraints: the network's own doing")
    parser.add_argument("--groups", nargs="+", metavar="GROUP", help="only these groups of tests")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes (default: 0)")
    parser.add_argument("--json", action="store_true", help="print JSON, nothing else")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write stress.json, stress.md and stress.png there")
    chosen = parser.parse_args(words[1:])
    from nmpm.evaluation.stress import FULL, GROUPS, QUICK

    unknown = sorted(set(chosen.groups or ()) - set(GROUPS))
    if unknown:
        raise ConfigError(f"--groups {' '.join(unknown)}: the groups are {', '.join(GROUPS)}.")
    subject = _subject(chosen.model, chosen.preset, chosen.seed)
    if chosen.free:
        subject = subject.with_emulator(subject.emulator.unconstrained())
    start = time.monotonic()
    lines = _measured(subject, FULL if chosen.full else QUICK, chosen.groups or list(GROUPS), quiet=chosen.json)
    _hand_out(subject, lines, "full" if chosen.full else "quick", time.monotonic() - start, chosen)
    if any(line.passed is False for line in lines):
        raise SystemExit(1)


def _subject(model: str, preset: str | None, seed: int) -> Subject:
    from nmpm.evaluation.stress import Subject

    path = Path(model)
    if path.suffix == ".ckpt" or path.is_file():
        from nmpm.training.checkpoints import load_module

        module = load_module(path)
        emulator, horizon = module.emulator, module.emulator.frames * module.unroll
        known = _preset(preset)
    else:
        from nmpm.zoo.registry import Zoo

        pretrained = Zoo.load(model)
        emulator = pretrained.emulator
        horizon = int(pretrained.card["training"].get("horizon", 4 * emulator.frames))
        known = _preset(preset or _name_of_preset(model))
    return Subject(model, emulator.eval().requires_grad_(False), horizon, known, seed)


def _preset(name: str | None) -> Preset | None:
    from nmpm.sim import load_preset

    return None if name is None else load_preset(name)


def _name_of_preset(model: str) -> str | None:
    """The preset of a zoo model that was trained on one of ours: they share their name."""
    from nmpm.sim import preset_names

    dataset = model.partition("/")[0]
    return dataset if dataset in preset_names() else None


def _measured(subject: Subject, size: Size, groups: list[str], quiet: bool) -> list[Line]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from nmpm.evaluation.stress import GROUPS, battery

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )
    lines: list[Line] = []
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=quiet) as progress:
        task = progress.add_task("stress", total=len(groups))
        for name in groups:
            progress.update(task, description=name)
            lines += battery(subject, size, {name: GROUPS[name]})
            progress.advance(task)
    return lines


def _hand_out(subject: Subject, lines: list[Line], size: str, seconds: float, chosen: argparse.Namespace) -> None:
    from rich.console import Console

    from nmpm.evaluation.stress.report import as_json, summary, table, write

    text = as_json(subject.name, size, seconds, lines)
    if chosen.json:
        sys.stdout.write(text + "\n")
    else:
        console = Console()
        console.print(table(f"{subject.name}, {size}, {seconds:.0f} s", lines))
        console.print(summary(lines))
    if chosen.report is not None:
        paths = write(chosen.report, text, lines)
        sys.stderr.write(f"wrote {', '.join(map(str, paths))}\n")
