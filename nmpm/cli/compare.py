"""`nmpm compare MODEL… --data DATASET`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.help import HelpFormatter
from nmpm.cli.options import MODEL, add_device_option, check_at_least, check_device, check_folder

if TYPE_CHECKING:
    from nmpm.emulator import Emulator
    from nmpm.evaluation.compare import Candidate, Outcome
    from nmpm.evaluation.trade import Scenes

DESCRIPTION = """Compare models on test scenes that they need not have been trained on: other particle counts, other
obstacles, a wider domain. A model of other scenes keeps its weights, and gets a grid over their domain with cells of
the size it was trained with. Beside the models stand trivial predictors and, for simulated scenes, the simulator's time
and what its own results are uncertain by."""

_EXAMPLES = """\
examples:
  nmpm compare waterramps waterdrop --data waterdrop-xl   for four times as many particles?
  nmpm compare waterramps --data waterramps --wider 2     ... in a domain twice as wide?
  nmpm compare goop runs/mine --data goop --scenes 30     your own model beside the zoo's
  nmpm compare runs/a runs/b --data FOLDER                on recorded data in native layout

It prints a table, and writes to the folder of --out: compare.json (all figures, of every scene), errors.png (error
against frames), frames.png (the first scene's splash and last frame, side by side), and points/, which holds every
measurement: with one more model, the same command measures only what is new. A model can predict scenes with the same
materials, gravity, time between frames and kinds of boundary as its own; others are refused by name.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["compare", "waterramps", "--data", "waterdrop-xl"]."""
    chosen = _parser().parse_args(words[1:])
    check_at_least("--scenes", chosen.scenes, 1)
    check_at_least("--wider", chosen.wider, 2)
    check_device(chosen.device)
    wider = f"-{chosen.wider}-times-as-wide" if chosen.wider else ""
    out = chosen.out or Path("compare") / f"{Path(chosen.data).name}{wider}"
    check_folder("--out", out)
    from nmpm._support.devices import find_device
    from nmpm.evaluation.compare import make_predictors
    from nmpm.evaluation.trade import find_scenes, find_wider_scenes

    models = _models(chosen.models)
    if chosen.wider:
        scenes = find_wider_scenes(chosen.data, chosen.scenes, chosen.wider)
    else:
        scenes = find_scenes(chosen.data, chosen.scenes)
    candidates = make_predictors(scenes, models, find_device(chosen.device))
    _report(_measure(candidates, scenes, out), scenes, out)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nmpm compare",
        description=DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("models", nargs="+", metavar="MODEL", help=MODEL)
    parser.add_argument(
        "--data", required=True, metavar="DATASET", help="an embedded dataset (goop, …), or a folder in native layout"
    )
    parser.add_argument("--scenes", type=int, default=6, help="number of test scenes (default: 6)")
    parser.add_argument(
        "--wider", type=int, metavar="TIMES", help="simulate scenes of a domain so many times as wide, with more blocks"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to write to (default: compare/DATASET)")
    add_device_option(parser)
    return parser


def _models(names: list[str]) -> dict[str, Emulator]:
    """Emulators by name; those of runs and entries by the folder's name where that is unique."""
    from nmpm.zoo import load_model

    short = {name: Path(name).name if Path(name).is_dir() else name for name in names}
    unique = len(set(short.values())) == len(short)
    return {short[name] if unique else name: load_model(name).emulator for name in names}


def _measure(candidates: list[Candidate], scenes: Scenes, out: Path) -> list[Outcome]:
    from nmpm._support.progress import progress_bar
    from nmpm.evaluation.compare import compare, count_steps
    from nmpm.evaluation.trade import Store

    with progress_bar("compare", count_steps(candidates, scenes)) as step:
        return compare(candidates, scenes, Store(out), step)


def _report(outcomes: list[Outcome], scenes: Scenes, out: Path) -> None:
    from rich.console import Console

    from nmpm.evaluation.compare import failure_lines, origin_lines, outcome_table, write_report

    console = Console()
    console.print(outcome_table(outcomes, scenes))
    for line in (*origin_lines(outcomes), *failure_lines(outcomes)):
        console.print(line, highlight=False, soft_wrap=True)
    paths = write_report(out, outcomes, scenes)
    sys.stderr.write(f"wrote {', '.join(map(str, paths))}\n")
