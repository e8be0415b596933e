"""`nmpm stress NAME`."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.shipped import find_preset
from nmpm.cli.match_options import MatchOptions, add_match_options, describe
from nmpm.cli.options import (
    CommandParser,
    add_device_option,
    add_model_options,
    add_runtime_option,
    add_threads_option,
    check_at_least,
    check_device,
    check_folder,
    check_model,
    check_runtime,
    choose_threads,
)
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.evaluation.stress import Effort, ModelUnderTest, TestResult
    from nmpm.sim import Preset

DESCRIPTION = """Test a trained model at the extremes: long rollouts, settling, fast and slow, many and few particles,
other boxes and grids, precision, sensitivity, obstacles that training never showed, non-finite input. Prints one line
per test: pass or fail by a stated invariant, with what was measured. Errors are against the simulator that made the
training data, where there is one. Exits with 1 if a line fails."""

_EXAMPLES = """\
examples:
  nmpm stress goop                          all tests, in minutes
  nmpm stress goop --groups long settling   some of them
  nmpm stress runs/goop --free              a run's best checkpoint, without constraints
  nmpm stress goop --full --report stress   longer and larger, with a table and a picture
  nmpm stress multimaterial --preset sandramps   on another simulator's scenes
"""


GROUP_NAMES = (
    *("long", "settling", "speeds", "counts", "sizes", "precision", "sensitivity", "obstacles", "poison", "free"),
)
"""Groups of `nmpm.evaluation.stress`, which imports torch."""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["stress", "goop"]."""
    arguments = _parser().parse_args(words[1:])
    check_at_least("--threads", arguments.threads, 1)
    if arguments.preset is not None:
        find_preset(arguments.preset)
    check_model(arguments.model, arguments.root)
    check_device(arguments.device)
    check_runtime(arguments.runtime)
    stated = MatchOptions.read(arguments.materials, arguments.stride, arguments.strict)
    if stated != MatchOptions() and not arguments.preset:
        raise ConfigError("--materials, --stride and --strict are about the scenes of a --preset: give it too.")
    if arguments.report is not None:
        check_folder("--report", arguments.report)
    if unknown := sorted(set(arguments.groups or ()) - set(GROUP_NAMES)):
        raise ConfigError(f"--groups {' '.join(unknown)}: the groups are {', '.join(GROUP_NAMES)}.")
    from nmpm.evaluation.stress import FULL, QUICK

    model = _load(arguments, stated)
    start = time.monotonic()
    results = _run_groups(model, FULL if arguments.full else QUICK, arguments.groups or list(GROUP_NAMES))
    _print_report(model, results, "full" if arguments.full else "quick", time.monotonic() - start, arguments)
    if any(result.passed is False for result in results):
        raise SystemExit(1)


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="nmpm stress", description=DESCRIPTION, epilog=_EXAMPLES)
    add_model_options(parser)
    add_device_option(parser)
    add_threads_option(parser)
    add_runtime_option(parser)
    parser.add_argument(
        "--full", action="store_true", help="longer and larger: tens of minutes (default: minutes, as zoo cards quote)"
    )
    parser.add_argument(
        "--preset",
        help="simulator of the scenes (default: of the training data; none if recorded); scenes of another kind than"
        " the model's are matched to it, as by nmpm rollout",
    )
    add_match_options(parser)
    parser.add_argument("--free", action="store_true", help="without the model's constraints: the network alone")
    parser.add_argument(
        "--groups",
        nargs="+",
        metavar="GROUP",
        help=f"only these, of {', '.join(GROUP_NAMES)} (default: all)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the scenes (default: 0)")
    parser.add_argument("--json", action="store_true", help="print JSON, and no table")
    parser.add_argument(
        "--report",
        type=Path,
        metavar="DIR",
        help="write stress.json, stress.md and stress.png there; stress_free.* with --free",
    )
    return parser


def _load(arguments: argparse.Namespace, stated: MatchOptions) -> ModelUnderTest:
    from nmpm.evaluation.stress import ModelUnderTest
    from nmpm.sim import load_preset
    from nmpm.zoo import load_model
    from nmpm.zoo.measures.scenes import simulator_of

    model = load_model(arguments.model, arguments.device, arguments.root).optimized(arguments.runtime)
    choose_threads(model, arguments.threads)
    if "open" in model.scene.boundary:
        raise ConfigError(
            f"{arguments.model}: these tests are of closed boxes, and the model's scenes have open axes."
            " `nmpm compare` and `nmpm rollout --data` measure it on recordings."
        )
    emulator = model.emulator.unconstrained() if arguments.free else model.emulator
    tested = ModelUnderTest(arguments.model, emulator, model.horizon, simulator_of(model), arguments.seed)
    return _match(tested, load_preset(arguments.preset), stated, arguments.json) if arguments.preset else tested


def _match(model: ModelUnderTest, preset: Preset, stated: MatchOptions, json: bool) -> ModelUnderTest:
    """The model on a preset's scenes; what matches them, where they are of another kind, is printed."""
    from nmpm.emulator.similarity import find_match
    from nmpm.scene import Motion

    match = find_match(model.emulator, preset.scene, Motion(), *stated, names=(model.name, preset.name))
    matched = model.over(preset, match)
    if matched.reading is not None:
        (sys.stderr if json else sys.stdout).write(describe(match, model.name))
    return matched


def _run_groups(model: ModelUnderTest, effort: Effort, groups: list[str]) -> list[TestResult]:
    from nmpm._support.progress import progress_bar
    from nmpm.evaluation.stress import GROUPS, battery

    results: list[TestResult] = []
    with progress_bar("stress", len(groups)) as step:
        for name in groups:
            step(f"stress, {name}", by=0)
            results += battery(model, effort, {name: GROUPS[name]})
            step()
    return results


def _print_report(
    model: ModelUnderTest, results: list[TestResult], size: str, seconds: float, arguments: argparse.Namespace
) -> None:
    from rich.console import Console

    from nmpm.evaluation.stress.results import as_json, summary, table, write

    text = as_json(model.name, size, seconds, results)
    if arguments.json:
        sys.stdout.write(text + "\n")
    else:
        console = Console()
        console.print(table(f"{model.name}, {size}, {seconds:.0f} s", results))
        console.print(summary(results))
    if arguments.report is not None:
        paths = write(arguments.report, text, results, "stress_free" if arguments.free else "stress")
        sys.stderr.write(f"wrote {', '.join(map(str, paths))}\n")
