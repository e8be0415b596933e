"""`nmpm trade DATASET`."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.help import HelpFormatter
from nmpm.cli.options import MODEL, add_device_option, check_at_least, check_device, check_folder, check_input
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.emulator import Emulator
    from nmpm.evaluation.gns import TrainedGraph
    from nmpm.evaluation.trade import Choice, Point, Scenes, Sweep

DESCRIPTION = """Measure the trade between speed and accuracy: time and errors of emulators, of the simulator with fewer
substeps and on coarser grids, and of trivial predictors, on the same test scenes and machine. Answers what to run for
a budget of milliseconds per frame, be it an emulator or not."""

_EXAMPLES = """\
examples:
  nmpm trade goop                               the zoo's models of goop beside its simulator
  nmpm trade goop --models goop runs/a runs/b   models of your own beside it
  nmpm trade goop --models goop runs/gns/minutes-10
                                                a particle-graph network, see benchmarks/gns.py
  nmpm trade FOLDER --models runs/mine          recorded data in native layout: without a simulator
  nmpm trade --print_config > sweep.yaml        what is measured; edit it, then:
  nmpm trade goop --config sweep.yaml

It writes to the folder of --out: trade.csv (one row for each choice and error), trade.png, trade.html (an interactive
page, self-contained), and points/, which holds every measurement: the same command goes on after an interruption, and
measures only what is new. Times of one CPU thread are CPU time, and all choices take turns; other load on the machine
still slows networks more than the simulator, so measure on an idle one. Delete points/times-* to time everything anew.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["trade", "goop"]."""
    chosen = _parser().parse_args(words[1:])
    if chosen.print_config:
        from nmpm.evaluation.trade import default_sweep_text

        sys.stdout.write(default_sweep_text())
        return
    _check(chosen)
    out = chosen.out or Path("trade") / Path(chosen.dataset).name
    check_folder("--out", out)
    from nmpm._support.devices import find_device
    from nmpm.evaluation.trade import find_scenes, make_choices

    sweep = _sweep(chosen)
    scenes = find_scenes(chosen.dataset, sweep.scenes)
    graphs = _graph_folders(chosen.models or [])
    models = _models(None if chosen.models is None else [n for n in chosen.models if n not in graphs], scenes)
    choices = make_choices(sweep, scenes, models, find_device(chosen.device), graphs)
    if not choices:
        raise ConfigError("There is nothing to measure: give --models, or settings of the simulator.")
    points = _measure(choices, scenes, sweep, out, chosen.keep_predictions)
    _report(points, scenes, out)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nmpm trade",
        description=DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("dataset", nargs="?", help="an embedded dataset (goop, …), or a folder in native layout")
    parser.add_argument(
        "--models",
        nargs="*",
        metavar="MODEL",
        help=f"{MODEL}, or a graph simulator's folder (default: the zoo's of this dataset)",
    )
    parser.add_argument("--scenes", type=int, help="number of test scenes (default: the sweep's, 20)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to write to (default: trade/DATASET)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML of what is measured, see --print_config")
    parser.add_argument("--print_config", action="store_true", help="print the shipped sweep, and stop")
    parser.add_argument("--keep-predictions", action="store_true", help="store all predictions, for other errors later")
    add_device_option(parser)
    return parser


def _check(chosen: argparse.Namespace) -> None:
    """Check the arguments before anything is loaded."""
    if chosen.dataset is None:
        raise ConfigError("name a dataset, such as goop, or the folder of one; see nmpm trade --help.")
    check_at_least("--scenes", chosen.scenes, 1)
    if chosen.config is not None:
        check_input("--config", chosen.config)
    check_device(chosen.device)


def _sweep(chosen: argparse.Namespace) -> Sweep:
    from nmpm._support.bounded_files import read_text
    from nmpm.evaluation.trade import default_sweep_text, read_sweep

    if chosen.config is None:
        sweep = read_sweep(default_sweep_text(), "the shipped sweep")
    else:
        sweep = read_sweep(read_text(chosen.config), str(chosen.config))
    if chosen.scenes is None:
        return sweep
    fitting = tuple(batch for batch in sweep.models.batch if batch <= chosen.scenes)
    models = dataclasses.replace(sweep.models, batch=fitting or (1,))
    return dataclasses.replace(sweep, scenes=chosen.scenes, models=models)


def _models(names: list[str] | None, scenes: Scenes) -> dict[str, Emulator]:
    """Models by name; those of the zoo that were trained on the dataset if none are named."""
    from nmpm.zoo import load_model

    if names is None:
        return _models_of(scenes.name)
    short = {name: Path(name).name if Path(name).is_dir() else name for name in names}
    unique = len(set(short.values())) == len(short)
    return {short[name] if unique else name: load_model(name).emulator for name in names}


def _models_of(dataset: str) -> dict[str, Emulator]:
    """The zoo's models of a simulated dataset by name; damaged ones are left out, and named on stderr."""
    from nmpm.errors import ZooError
    from nmpm.zoo import Zoo, load_model
    from nmpm.zoo.card import preset_of

    found = {}
    for name in Zoo.list():
        try:
            if preset_of(Zoo.card(name)) == dataset:
                found[name] = load_model(name).emulator
        except ZooError as error:
            sys.stderr.write(f"left out: {error}\n")
    return found


def _graph_folders(names: list[str]) -> dict[str, TrainedGraph]:
    """Those of the models that are folders of graph simulators, by name."""
    from nmpm.evaluation.gns import is_graph_folder, read_graph

    return {name: read_graph(Path(name)) for name in names if is_graph_folder(Path(name))}


def _measure(choices: list[Choice], scenes: Scenes, sweep: Sweep, out: Path, keep: bool) -> list[Point]:
    from nmpm._support.progress import progress_bar
    from nmpm.evaluation.trade import Store, count_steps, measure

    with progress_bar("trade", count_steps(choices, scenes, sweep)) as step:
        return measure(choices, scenes, sweep, Store(out, keep), step)


def _report(points: list[Point], scenes: Scenes, out: Path) -> None:
    from rich.console import Console

    from nmpm.evaluation.trade.report import advice_lines, write_report
    from nmpm.evaluation.trade.table import failure_lines, pareto_table

    console = Console()
    console.print(pareto_table(points, scenes))
    for line in (*advice_lines(points), *failure_lines(points)):
        console.print(line, highlight=False, soft_wrap=True)
    paths = write_report(out, points, scenes)
    sys.stderr.write(f"wrote {', '.join(map(str, paths))}\n")
