"""`nmpm zoo match DATA`: all models on a few windows of a dataset, and which to start from."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.match_options import MatchOptions, add_reading_options
from nmpm.cli.options import add_data_options, check_exists, data_options, derived_name, stated_facts

if TYPE_CHECKING:
    from rich.table import Table

    from nmpm.zoo.ranking import Standing, Trial

ABOUT = "predict a few windows of your data by every model: which to use, and to start a fine-tuning from"
EXAMPLES = """\
examples:
  nmpm zoo match grains
  nmpm zoo match grains.npz --materials big=sand,small=sand
  nmpm zoo match waterdrop --family deepmind --gravity 0,-9.81
"""


_WORDS = ("gravity", "speeds", "particles to a cell", "boundary", "obstacles")
"""Of warnings, in short."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("data", type=Path, help="a dataset, of any format that nmpm convert reads")
    add_reading_options(parser)
    add_data_options(parser)


def match(options: argparse.Namespace) -> None:
    """Print the ranking, and the commands that go on with the best model."""
    check_exists("DATA", options.data)
    stated, facts = MatchOptions.read(options.materials, options.stride), data_options(options)
    from rich.console import Console

    from nmpm._support.progress import progress_bar
    from nmpm.data.dataset import Dataset
    from nmpm.data.loading.sources import FolderSource
    from nmpm.zoo.ranking import Ranking, Trial
    from nmpm.zoo.registry import Zoo, load_model

    trial = Trial.of(Dataset(FolderSource(options.data, facts)))
    names = Zoo.list(options.root)
    loaders = {name: (lambda name=name: load_model(name, root=options.root).emulator) for name in names}
    with progress_bar("models", len(names)) as step:
        standings = Ranking(trial, stated.materials, stated.stride).rank(loaders, step)
    Console().print(_table(trial, standings))
    best = next((one for one in standings if one.match is not None and math.isfinite(one.error)), None)
    sys.stdout.write("".join(f"{line}\n" for line in _advice(options, best)))


def _table(trial: Trial, standings: Sequence[Standing]) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    models = f"{trial.name}, {trial.scene.dim}-D models"
    table = Table(
        title=f"{models}: errors at {trial.frames} frames over that of the better trivial predictor",
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=0,
        collapse_padding=True,
    )
    table.add_column("model", no_wrap=True)
    for heading in ("error", "cells", "stride", "gravity"):
        table.add_column(heading, justify="right", no_wrap=True)
    for heading in ("materials", "not matched"):
        table.add_column(heading)
    for one in standings:
        table.add_row(*_row(one))
    for name, error in (("nothing moves", trial.still), ("free fall", trial.free_fall)):
        table.add_row(name, f"{error / trial.trivial:.2g}")
    return table


def _row(one: Standing) -> list[str]:
    error = f"{one.error:.2g}" if math.isfinite(one.error) else ""
    if one.match is None:
        return [one.model, error, "", "", "", "", one.failure]
    reading, recipe = one.match.reading, one.match.recipe
    unmatched = [word for word in _WORDS if any(word in warning.lower() for warning in one.match.warnings)]
    return [
        one.model,
        error,
        "×".join(map(str, recipe.grid.shape)),
        str(reading.every) if reading.between == 1 else f"1/{reading.between}",
        "" if one.match.gravity is None else f"× {one.match.gravity:.3g}",
        ", ".join(f"{name}={theirs}" for name, theirs in (one.stated or {}).items()),
        ", ".join([*unmatched, *([one.failure] if one.failure else [])]),
    ]


def _advice(options: argparse.Namespace, best: Standing | None) -> list[str]:
    """What could not be matched of the best model, and the commands that use it."""
    if best is None or best.match is None:
        return ["No model takes these data: nmpm init writes a configuration for a training from nothing."]
    lines = [f"warning: {warning}" for warning in best.match.warnings]
    if best.error >= 1:
        lines.append("No model is better than a trivial predictor; a fine-tuning may be.")
    materials = ",".join(f"{name}={theirs}" for name, theirs in (best.stated or {}).items())
    stated = [
        *(["--materials", materials] if materials else []),
        *(["--stride", options.stride] if options.stride else []),
    ]
    facts = stated_facts(options)
    data = derived_name(options.data, "").name + "-stated" if facts else str(options.data)
    if facts:
        lines.append(f"first state it:   {shlex.join(['nmpm', 'convert', str(options.data), data, *facts])}")
    rollout, fit = ["rollout", best.model, "--data", data], ["fit", "--start_from", best.model, "--data.path", data]
    lines += [f"as it is:         {shlex.join(['nmpm', *rollout, *stated])}"]
    return [*lines, f"to start from it: {shlex.join(['nmpm', *fit, *stated])}"]
