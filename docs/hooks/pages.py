"""MkDocs hook: pages that are not written in `docs/`, but made of other files of the repository at each build.

Included as they are: the root's Markdown files, README.md as the start page, and those of `benchmarks/` and `zoo/` with
their pictures. Generated: help of all commands, the explained configuration, and a page for each room of the package.
"""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path
from unittest import mock

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from nmpm.cli import COMMANDS, main, usage

ROOT = Path(__file__).parents[2]
INCLUDED = ("[A-Z]*.md", "benchmarks/**/*.md", "zoo/**/*.md", "notebooks/*.ipynb")
ASSETS = ("benchmarks/**/*.png", "benchmarks/**/*.html", "zoo/**/*.png")
TRAINING = ("fit", "validate", "test", "predict")
ZOO = ("list", "card", "add", "verify", "refresh", "push", "pull")
TERMINAL = {"COLUMNS": "100", "NO_COLOR": "1"}

ROOMS = (
    "nmpm",
    "nmpm.zoo",
    "nmpm.emulator",
    "nmpm.emulator.constraints",
    "nmpm.emulator.monitor",
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
    pages = {"reference/commands.md": commands_page(), "reference/configuration.md": configuration_page()}
    return pages | {f"reference/{room}.md": room_page(room) for room in ROOMS}


def commands_page() -> str:
    """Help of all commands."""
    sections = [f"# Commands\n\n{_block(usage())}"]
    for name, (_, summary) in COMMANDS.items():
        short = name in TRAINING and name != "fit"  # as fit
        sections.append(f"## nmpm {name}\n\n{_training(summary) if short else _block(help_of(name))}")
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


def room_page(room: str) -> str:
    """Public names of a room of the package, for mkdocstrings."""
    return f"# {room}\n\n::: {room}\n"


def _training(summary: str) -> str:
    return f"{summary} Its options are those of `nmpm fit`, and of the [configuration](configuration.md)."


def _block(text: str) -> str:
    return f"```text\n{text.rstrip()}\n```"
