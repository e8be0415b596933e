"""MkDocs hook: pages that are not written in `docs/`, but made of other files of the repository at each build.

Included as they are: the root's Markdown files, README.md as the start page, and those of `benchmarks/` and `zoo/` with
their pictures. Generated: help of all commands, the explained configuration, what runs where by the tables of engines,
and a page for each room of the package.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Collection, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from nmpm.backends import ENGINES
from nmpm.cli import COMMANDS, main
from nmpm.cli.command import summary
from nmpm.emulator.engines import rules
from nmpm.emulator.runtimes import OpenVINO, Windows
from nmpm.zoo.export.parts import Network, Solid, Step

ROOT = Path(__file__).parents[2]
INCLUDED = ("[A-Z]*.md", "benchmarks/**/*.md", "zoo/**/*.md", "notebooks/*.ipynb")
ASSETS = ("benchmarks/**/*.png", "benchmarks/**/*.html", "zoo/**/*.png")
TRAINING = ("fit", "validate", "test", "predict")
ZOO = ("list", "card", "match", "add", "verify", "refresh", "push", "pull")
TERMINAL = {"COLUMNS": "100", "NO_COLOR": "1"}

ROOMS = (
    "nmpm",
    "nmpm.zoo",
    "nmpm.emulator",
    "nmpm.emulator.constraints",
    "nmpm.emulator.monitor",
    "nmpm.emulator.trust",
    "nmpm.obstacles",
    "nmpm.training.losses",
    "nmpm.processors",
    "nmpm.transfer",
    "nmpm.decoders",
    "nmpm.metrics",
    "nmpm.data.convert",
    "nmpm.sim",
    "nmpm.viz",
    "nmpm.testing",
    "nmpm.errors",
)


FIRST = {"nmpm": ("Zoo", "rollout", "EmulatorModule", "TrajectoryDataModule")}
"""What users need first, by room."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Adds the zoo's models to the navigation, so that each page leads to the next."""
    models = next(item["Models"] for item in config.nav or [] if "Models" in item)
    models += [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "zoo").glob("*/**/README.md"))]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages and assets to those of `docs/`."""
    for pattern in (*INCLUDED, *ASSETS):
        for path in sorted(ROOT.glob(pattern)):
            uri = path.relative_to(ROOT).as_posix()
            files.append(File(uri, str(ROOT), config.site_dir, config.use_directory_urls))
    for uri, text in generated_pages().items():
        files.append(File.generated(config, uri, content=text))
    return files


def generated_pages() -> dict[str, str]:
    """Markdown by path within the site."""
    pages = {
        "reference/commands.md": commands_page(),
        "reference/configuration.md": configuration_page(),
        "what_runs_where.md": engines_page(),
    }
    return pages | {f"reference/{room}.md": room_page(room) for room in ROOMS}


def commands_page() -> str:
    """Help of all commands."""
    sections = [f"# Commands\n\n{_block(help_of())}"]
    for name in COMMANDS:
        short = name in TRAINING and name != "fit"  # as fit
        sections.append(f"## nmpm {name}\n\n{_training(summary(COMMANDS[name])) if short else _block(help_of(name))}")
        if name == "zoo":
            sections += [f"### nmpm zoo {action}\n\n{_block(help_of(name, action))}" for action in ZOO]
    return "\n\n".join(sections)


def help_of(*words: str) -> str:
    """What a command prints on `--help`, in a terminal of fixed width."""
    printed = io.StringIO()
    with mock.patch.dict(os.environ, TERMINAL), contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return printed.getvalue()


def configuration_page() -> str:
    """The explained configuration, and the names of the others."""
    configs = sorted((ROOT / "configs").glob("**/*.yaml"))
    names = ", ".join(f"`{path.relative_to(ROOT / 'configs')}`" for path in configs)
    explained = (ROOT / "configs" / "tutorial.yaml").read_text(encoding="utf-8")
    return (
        "# Configuration\n\n"
        "What `nmpm fit`, `validate`, `test` and `predict` are told, in files (`--config`) or on the command line"
        " (`--model.frames 4`). `nmpm fit --config goop.yaml --print_config` prints a whole configuration,"
        " `nmpm fit --help_all` every option, `nmpm fit --model.processor.help nmpm.processors.UNet` those of a"
        " part.\n\n"
        f"Shipped: {names}. This is `tutorial.yaml`:\n\n```yaml\n{explained}```\n"
    )


def engines_page() -> str:
    """What runs where, by the tables of `nmpm.emulator.engines.rules`."""
    everything = [rule.feature for rule in (*rules.MODELS, *rules.CALLS)]
    engines = {"torch": everything} | {f.name: f.features for name in ENGINES.built_in for f in ENGINES[name]}
    runtimes = {kind.name: kind.features for kind in (OpenVINO, Windows)}
    parts = {part.__name__.lower(): part.features for part in (Step, Network, Solid)}
    tried = "\n".join(f"| {name} | {where} |" for name, where in rules.TRIED.items())
    refusals = "\n".join(f"- {rule.feature}" for rule in rules.RECORDINGS)
    errors = "\n".join(f"- {rule.feature}" for rule in rules.TRAINING_ERRORS)
    return (
        "# What runs where\n\n"
        "A call of a model is computed by an *engine*: torch's operations, which take everything, or kernels that are"
        " faster and take what is marked here. Everything that a model and its call have must be marked: else the call"
        " is torch's, with the same result to rounding. The *network* between is run by torch, or by a *runtime* that"
        " is asked for (`model.optimized()`, `--runtime`). `model.explain()` and `nmpm zoo card NAME` say what this"
        " means for a model here.\n\n"
        f"## Engines: models\n\n{_table(rules.MODELS, engines)}\n\n"
        f"## Engines: calls\n\n{_table(rules.CALLS, engines)}\n\n"
        "## CUDA graphs\n\n"
        "On a CUDA GPU rollouts' calls are recorded when a shape of state comes again, and replayed from then on."
        f" Not recorded are shapes that change with each call, and:\n\n{refusals}\n\n"
        "## Runtimes\n\nThey compute the network of rollouts, without gradients. What is not marked is refused in one"
        " line.\n\n"
        f"{_table(rules.NETWORKS, runtimes)}\n\n"
        "## Exported files\n\n`nmpm export` writes the *step* (a whole call), with `--processor` the *network* alone,"
        " with `--solid` the cells of obstacles. What is not marked is refused in one line; all else is exported.\n\n"
        f"{_table(rules.EXPORTS, parts)}\n\n"
        "## Errors of trainings\n\n"
        f"Numba's kernels compute the losses of positions and densities too, but for:\n\n{errors}\n\n"
        f"## Where this has run\n\n| | on |\n|---|---|\n{tried}\n"
    )


def _table(rows: Sequence[rules.Rule[Any]], columns: Mapping[str, Collection[str]]) -> str:
    """Features, and a mark in each column for those that it takes."""
    lines = [["feature", *columns], ["---", *([":-:"] * len(columns))]]
    lines += [[rule.feature, *("✓" if rule.feature in taken else "" for taken in columns.values())] for rule in rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def room_page(room: str) -> str:
    """Public names of a room of the package, for mkdocstrings; those of `FIRST` before the others."""
    names = [name for name in FIRST.get(room, ()) if name in public_names(room)]
    if not names:
        return f"# {room}\n\n::: {room}\n"
    listed = "\n".join(f"        - {name}" for name in [*names, *(n for n in public_names(room) if n not in names)])
    options = f"group_by_category: false\n      members_order: __all__\n      members:\n{listed}"
    return f"# {room}\n\n::: {room}\n    options:\n      {options}\n"


def public_names(room: str) -> list[str]:
    """The names of a room's `__all__`."""
    return [name for name in import_module(room).__all__ if not name.startswith("_")]


def _training(sentence: str) -> str:
    return f"{sentence} Its options are those of `nmpm fit`, and of the [configuration](configuration.md)."


def _block(text: str) -> str:
    return f"```text\n{text.rstrip()}\n```"
