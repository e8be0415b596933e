"""Options about the data that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.convert import Options


def add_data_options(parser: argparse.ArgumentParser) -> None:
    """Adds what a user may say of data whose files leave it open, or are wrong."""
    group = parser.add_argument_group("what the files leave open, or get wrong")
    group.add_argument("--family", help="what type ids mean: deepmind, lagrangebench or jax-sph")
    group.add_argument("--types", metavar="ID=NAME,...", help="names of particle types, e.g. 5=water,1=debris")
    group.add_argument("--static", metavar="ID,...", help='types that never move, e.g. 1,3; "none" where all move')
    group.add_argument("--bounds", metavar="LOW:HIGH,...", help="where particles may be, per axis, e.g. 0:1,0:0.5")
    group.add_argument("--dt", type=float, help="seconds between stored frames")
    group.add_argument("--gravity", metavar="X,Y[,Z]", help="acceleration in length/s², e.g. 0,-9.81")
    group.add_argument("--boundary", metavar="KIND,...", help='"wall" or "periodic" per axis, e.g. periodic,wall')


def data_options(chosen: argparse.Namespace) -> Options:
    """What the user said.

    Raises:
        ConfigError: naming the option that cannot be read.
    """
    from nmpm.data.convert import Options
    from nmpm.data.families import find_family

    if chosen.family is not None:
        find_family(chosen.family)
    return Options(
        family=chosen.family,
        types=_parsed("--types", chosen.types, _names, "ID=NAME pairs, e.g. 5=water,1=debris"),
        static=_parsed("--static", chosen.static, _ids, 'type ids, e.g. 1,3, or "none"'),
        bounds=_parsed("--bounds", chosen.bounds, _intervals, "LOW:HIGH for each axis, e.g. 0:1,0:0.5"),
        dt=chosen.dt,
        gravity=_parsed("--gravity", chosen.gravity, _numbers, "a number for each axis, e.g. 0,-9.81"),
        periodic=_parsed("--boundary", chosen.boundary, _kinds, '"wall" or "periodic" for each axis'),
    )


def new_ids(text: str | None) -> dict[int, int] | None:
    """The pairs of `--ids`.

    Raises:
        ConfigError: if they cannot be read.
    """
    pairs: dict[int, int] | None = _parsed("--ids", text, _pairs, "OLD=NEW pairs of type ids, e.g. 5=0,3=1")
    return pairs


def _pairs(text: str) -> dict[int, int]:
    return {number: int(name) for number, name in _names(text).items()}


def _parsed(flag: str, text: str | None, parse: Callable[[str], Any], wanted: str) -> Any:
    if text is None:
        return None
    try:
        return parse(text)
    except ValueError as error:
        raise ConfigError(f"{flag} {text}: give {wanted}.") from error


def _names(text: str) -> dict[int, str]:
    pairs = [pair.split("=") for pair in text.split(",")]
    return {int(number): name.strip() for number, name in pairs}


def _ids(text: str) -> frozenset[int]:
    return frozenset() if text == "none" else frozenset(map(int, text.split(",")))


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split(",")))


def _intervals(text: str) -> tuple[tuple[float, float], ...]:
    pairs = [tuple(map(float, pair.split(":"))) for pair in text.split(",")]
    if any(len(pair) != 2 or not pair[0] < pair[1] for pair in pairs):
        raise ValueError(text)
    return tuple((pair[0], pair[1]) for pair in pairs)


def _kinds(text: str) -> tuple[bool, ...]:
    kinds = text.split(",")
    if not set(kinds) <= {"wall", "periodic"}:
        raise ValueError(text)
    return tuple(kind == "periodic" for kind in kinds)
