"""`nmpm trade DATASET`, and the parts that `nmpm compare` shares with it."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.messages import counted
from nmpm.cli.match_options import MatchOptions, add_match_options
from nmpm.cli.options import (
    MODEL,
    CommandParser,
    add_data_options,
    add_device_option,
    add_style_option,
    check_at_least,
    check_data,
    check_device,
    check_folder,
    check_input,
    check_model,
    data_options,
    stated_facts,
)
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.zoo import Pretrained

DESCRIPTION = """Measure the trade between speed and accuracy: time and errors of emulators, of the simulator with fewer
substeps and on coarser grids, and of trivial predictors, on the same test scenes and machine. Answers what to run for
a budget of milliseconds per frame, be it an emulator or not."""

_EXAMPLES = """\
examples:
  nmpm trade goop                               the zoo's models of goop beside its simulator
  nmpm trade goop --models goop runs/a runs/b   models of your own beside it
  nmpm trade goop --predictors mine:make        a predictor of another package: make(scene) gives it
  nmpm trade waterramps --members 8             ensembles of the models, judged by their fair CRPS
  nmpm trade FOLDER --models runs/mine          recorded data: errors, and how long the rest takes
  nmpm trade FOLDER --models runs/mine --times  ... and the rest: times, precisions, batches
  nmpm trade --print_config > sweep.yaml        what is measured; edit it, then:
  nmpm trade goop --config sweep.yaml

It writes to the folder of --out: trade.csv (one row for each choice and error), trade.md (the table), trade.json (all
figures of every scene), trade.png (error against time), errors.png (error against frames), frames.png (the first
scene, side by side), and points/, which holds every measurement: the same command goes on after an interruption, and
measures only what is new. Times of one CPU thread are CPU time, and all choices take turns; other load on the machine
still slows networks more than the simulator, so measure on an idle one. Delete points/times-* to time everything anew.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["trade", "goop"]."""
    options = _parser().parse_args(words[1:])
    if options.print_config:
        from nmpm.evaluation.trade import shipped_sweep_text

        sys.stdout.write(shipped_sweep_text("trade"))
        return
    if options.dataset is None:
        raise ConfigError("name a dataset, such as goop, or the folder of one; see nmpm trade --help.")
    if options.config is not None:
        check_input("--config", options.config)
    check_data("DATASET", Path(options.dataset))
    options.words = words
    measure_and_report("trade", options, options.dataset)


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="nmpm trade", description=DESCRIPTION, epilog=_EXAMPLES)
    parser.add_argument("dataset", nargs="?", help="an embedded dataset (goop, …), or a file or folder of data")
    parser.add_argument("--models", nargs="*", metavar="MODEL", help=f"{MODEL} (default: the zoo's of this dataset)")
    parser.add_argument(
        "--predictors", nargs="*", default=[], metavar="MODULE:FACTORY[:ARGUMENT]",
        help="predictors of other packages: the module is imported, and its code runs",
    )  # fmt: skip
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML of what is measured, see --print_config")
    parser.add_argument(
        "--times", action="store_true",
        help="of recorded data, whose errors alone are measured first: times, too, and all forms of the models",
    )  # fmt: skip
    parser.add_argument("--print_config", action="store_true", help="print the shipped sweep, and stop")
    parser.add_argument(
        "--members", type=int, metavar="M", help="also an ensemble of M rollouts of each model, and everybody's CRPS"
    )
    add_scene_options(parser, "trade", scenes=20)
    return parser


def add_scene_options(parser: argparse.ArgumentParser, command: str, scenes: int) -> None:
    """Add the options that both commands have."""
    parser.add_argument("--scenes", type=int, help=f"number of test scenes (default: {scenes})")
    parser.add_argument(
        "--wider", type=int, metavar="TIMES", help="simulate scenes of a domain so many times as wide, with more blocks"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"folder to write to (default: {command}/DATASET)")
    add_style_option(parser, "also the chart of time and error")
    add_device_option(parser)
    add_match_options(parser)
    add_data_options(parser)


def measure_and_report(command: str, options: argparse.Namespace, dataset: str) -> None:
    """Measure the sweep of a command on a dataset, print the table, and write the report."""
    for name in options.models or ():
        check_model(name)
    check_device(options.device)
    match, facts = MatchOptions.read(options.materials, options.stride, options.strict), data_options(options)
    check_at_least("--scenes", options.scenes, 1)
    check_at_least("--wider", options.wider, 2)
    check_at_least("--members", options.members, 1)
    if options.wider and (stated := stated_facts(options)):
        raise ConfigError(f"{stated[0]}: --wider simulates scenes, and their facts are known: leave it out.")
    wider = f"-{options.wider}-times-as-wide" if options.wider else ""
    out = options.out or Path(command) / f"{Path(dataset).name}{wider}"
    check_folder("--out", out)
    from rich.console import Console

    from nmpm._support.bounded_files import read_text
    from nmpm._support.devices import find_device
    from nmpm.evaluation import trade
    from nmpm.evaluation.trade.report import likely_points, report_lines, summary_table, write_report
    from nmpm.viz.output import STYLES

    if options.config is None:
        sweep = trade.read_sweep(trade.shipped_sweep_text(command), f"the sweep of nmpm {command}")
    else:
        sweep = trade.read_sweep(read_text(options.config), str(options.config))
    sweep = sweep if options.scenes is None else sweep.with_scenes(options.scenes)
    sweep = sweep if options.members is None else sweep.with_members(options.members)
    predictors = [trade.find_factory(path) for path in options.predictors]
    models = _models_of(Path(dataset).name) if options.models is None else _load_models(options.models)
    if options.wider:
        scenes = trade.find_wider_scenes(dataset, sweep.scenes, options.wider)
    else:
        scenes = trade.find_scenes(dataset, sweep.scenes, facts)
    _check_materials(match, models)
    device = find_device(options.device)
    emulators = {name: model.emulator for name, model in models.items()}
    nudges = {name: model.nudge for name, model in models.items()}
    choices = trade.make_choices(sweep, scenes, emulators, device, predictors, nudges, **match._asdict())
    if not choices:
        raise ConfigError("There is nothing to measure: give --models, or settings of the simulator.")
    for line in sweep.models.left_out(device) if models else []:
        sys.stdout.write(f"{line}\n")
    store, rest = trade.Store(out), ""
    asked_for_all = options.times or options.config or options.members
    errors_first = (
        scenes.preset is None and not asked_for_all and trade.estimate_rest(choices, scenes, sweep, store)[0] > 0
    )
    try:
        if errors_first:
            points = trade.measure_untimed(trade.first_forms(choices), scenes, sweep, store, command)
            rest = _describe_rest(*trade.estimate_rest(choices, scenes, sweep, store), options.words)
        else:
            points = trade.measure(choices, scenes, sweep, store, command)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; what is measured is in {out}, and the same command goes on.") from None
    console = Console()
    shown = likely_points(points) if command == "trade" and not errors_first else points
    console.print(summary_table(shown, points, scenes))
    for line in report_lines(points):
        console.print(line, highlight=False, soft_wrap=True)
    paths = write_report(out, command, points, scenes, options.style and STYLES[options.style])
    sys.stderr.write(f"wrote {', '.join(map(str, paths))}\n")
    sys.stdout.write(rest)


def _describe_rest(count: int, seconds: float, words: list[str]) -> str:
    """A line about what is not measured yet: how much, about how long it takes, and the command."""
    time = timedelta(seconds=max(1, round(seconds)))
    return (
        f"next: times, and the models in other forms: {counted(count, 'measurement')}, about {time}\n"
        f"  {shlex.join(['nmpm', *words, '--times'])}\n"
    )


def _check_materials(match: MatchOptions, models: Mapping[str, Pretrained]) -> None:
    """Raise ConfigError if no model has the materials that an option names; those that have are matched by them."""
    named = set((match.materials or {}).values())
    if models and not any(named <= set(model.scene.materials) for model in models.values()):
        known = sorted({name for model in models.values() for name in model.scene.materials})
        raise ConfigError(f"--materials: no model has {', '.join(sorted(named))}; they have {', '.join(known)}.")


def _load_models(names: list[str]) -> dict[str, Pretrained]:
    """Models by name; those of runs and entries by the folder's name where that is unique."""
    from nmpm.zoo import load_model

    short = {name: Path(name).name if Path(name).is_dir() else name for name in names}
    unique = len(set(short.values())) == len(short)
    return {short[name] if unique else name: load_model(name) for name in names}


def _models_of(dataset: str) -> dict[str, Pretrained]:
    """The zoo's models of a simulated dataset by name; damaged ones are left out, and named on stderr."""
    from nmpm.errors import ZooError
    from nmpm.zoo import Zoo, load_model
    from nmpm.zoo.card import preset_of

    models = {}
    for name in Zoo.list():
        try:
            if preset_of(Zoo.card(name)) == dataset:
                models[name] = load_model(name)
        except ZooError as error:
            sys.stderr.write(f"left out: {error}\n")
    return models
