"""Options that say how a model reads data of another kind than its own; they are read without torch."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, NamedTuple

from nmpm.cli.options import parse_option

if TYPE_CHECKING:
    from nmpm.emulator.similarity import Match

MATERIALS = "names of the data's materials, each with the model's material that it is, e.g. big=sand,small=sand"
STRIDE = (
    "frames of the data for one of the model, e.g. 2; or 1/4, where the model makes four of one (default: what matches"
    " gravity best, or else speeds)"
)
STRICT = "refuse data that are not of the model's kind in gravity, frames, particles, speeds or walls"


def add_match_options(parser: argparse.ArgumentParser) -> None:
    """Add --materials, --stride and --strict."""
    add_reading_options(parser).add_argument("--strict", action="store_true", help=STRICT)


def add_reading_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add --materials and --stride."""
    group = parser.add_argument_group("data of another kind than the model's")
    group.add_argument("--materials", metavar="DATA=MODEL,...", help=MATERIALS)
    group.add_argument("--stride", metavar="K", help=STRIDE)
    return group


class MatchOptions(NamedTuple):
    """Arguments of `nmpm.emulator.similarity.find_match` that a user states; what is None is found there."""

    materials: Mapping[str, str] | None = None
    stride: Fraction | None = None
    strict: bool = False

    @classmethod
    def read(cls, materials: str | None, stride: str | None, strict: bool = False) -> MatchOptions:
        """The options of these texts; raises ConfigError, naming the option that cannot be read."""
        return cls(
            parse_option("--materials", materials, _pairs, "DATA=MODEL pairs of names, e.g. big=sand,small=sand"),
            parse_option("--stride", stride, _stride, "a whole number of the data's frames, e.g. 2, or a part, 1/4"),
            strict,
        )


def describe(match: Match, name: str) -> str:
    """How the model of a name takes data, and what could not be matched, in lines."""
    lines = [f"{name} takes these data as follows.", *(f"  {line}" for line in match.lines)]
    return "".join(f"{line}\n" for line in (*lines, *(f"warning: {warning}" for warning in match.warnings)))


def _pairs(text: str) -> dict[str, str]:
    pairs = [[name.strip() for name in pair.split("=")] for pair in text.split(",")]
    if any(len(pair) != 2 or not all(pair) for pair in pairs):
        raise ValueError(text)
    renamed = dict(pairs)
    if len(renamed) < len(pairs):
        raise ValueError(text)
    return renamed


def _stride(text: str) -> Fraction:
    if not re.fullmatch(r"(1/)?0*[1-9][0-9]*", text):
        raise ValueError(text)
    return Fraction(text)
