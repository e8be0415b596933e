"""`nmpm init PATH`, and the configuration that `nmpm fit --data.path PATH` makes where it is given none."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.command import option
from nmpm.cli.options import Existing, FactOptions, check_output
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.convert import Options

MINUTES = 15.0
_SHOWN = ("max_steps:", "cells:", "constraints:", "gravity:", "# dt ")
"""Beginnings of the lines that `nmpm fit` prints of a configuration."""


@dataclass(frozen=True, kw_only=True)
class Init(FactOptions):
    """Write a configuration for a dataset, chosen by what its trajectories show.

    The dataset may be of any format that nmpm convert reads; nmpm fit trains on it by the configuration.

    What the trajectories show is written beside each value: how many particles an occupied cell has, whether energy
    comes in, whether scenes come to rest, how gravity and walls were found and how sure that is. The rules are those
    of the shipped configurations (docs/recipes.md); the speed of this machine is measured for a second.

    Args:
        path: A dataset, of any format that nmpm convert reads.
        out: File to write (default: NAME.yaml).
        minutes: Of the training.

    Examples:
        nmpm init grains                              writes grains.yaml; look at it, then:
        nmpm fit --config grains.yaml                 train, test, draw
        nmpm init run.npz --out long.yaml --minutes 120
                                                      a finer grid for a longer training
        nmpm init grains --gravity 0,-9.81            what you know better than the data show
        nmpm fit --data.path grains                   all at once, into runs/grains

        Names of types and the time step are no part of a configuration; they go into a copy of the data:

        nmpm convert grains NEW --types 1=steel,2=glass --dt 0.004
        nmpm init NEW
    """

    path: Existing
    out: Path | None = option(metavar="FILE")
    minutes: float = MINUTES

    def __post_init__(self) -> None:
        super().__post_init__()
        for argument in self.arguments:
            name, text = argument.split("=", 1)
            if name in ("--types", "--static", "--dt"):
                raise ConfigError(
                    f"{name}: a configuration cannot state it; write it into a copy of the data: nmpm convert"
                    f" {self.path} NEW {name} {text}, then nmpm init NEW."
                )
        if not self.minutes > 0:
            raise ConfigError(f"--minutes {self.minutes:g}: it must be positive.")

    def run(self) -> None:
        name = dataset_name(self.path)
        out = self.out or Path(f"{name}.yaml")
        if out.exists():
            raise ConfigError(f"{out} exists already: delete it, or choose another file with --out.")
        check_output("--out", out)
        _write(self.path, self.facts, out, f"runs/{name}", self.minutes)
        sys.stdout.write(f"wrote {out}; to train by it: nmpm fit --config {shlex.quote(str(out))}\n")


def write_for_fit(path: Path, options: Options, root: Path, minutes: float) -> Path:
    """Write the configuration of a training without one into its run's folder, and print its most important lines."""
    from nmpm.cli.run_folder import next_folder

    root, _ = next_folder(root)
    root.mkdir(parents=True, exist_ok=True)
    out = root / "init.yaml"
    lines = _write(path, options, out, str(root), minutes)
    shown = [line.strip() for line in lines if line.strip().startswith(_SHOWN)]
    sys.stdout.write(f"No --config: wrote {out} for these data, {minutes:.3g} minutes:\n")
    sys.stdout.writelines(f"  {line}\n" for line in shown)
    sys.stdout.flush()
    return out


def _write(path: Path, options: Options, out: Path, root: str, minutes: float) -> Sequence[str]:
    """Write a configuration for a dataset, and return its lines."""
    from nmpm._support.atomic import atomic_write
    from nmpm.data.new_configuration import CompletedSource, SettingsChoice
    from nmpm.data.sources import FolderSource
    from nmpm.evaluation.pace import measure_machine

    source = CompletedSource.of(FolderSource(path, options))
    choice = SettingsChoice.of(source, measure_machine(source.data.scene.dim, minutes))
    text = choice.configuration(str(path), root)
    with atomic_write(out) as part:
        part.write_text(text, encoding="utf-8")
    return text.splitlines()


def dataset_name(path: Path) -> str:
    """A name for files and runs of a dataset."""
    path = path.resolve()
    name = path.stem if path.is_file() else path.name
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name) or "dataset"
