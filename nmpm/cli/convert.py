"""`nmpm convert SOURCE DESTINATION`, both ways."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.options import (
    CommandParser,
    add_data_options,
    check_at_least,
    check_folder,
    data_options,
    parse_option,
)
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.convert import Options

_DESCRIPTION = """\
Bring a dataset of another format into the native layout (LagrangeBench's HDF5 files with a metadata.json), or
trajectories into files for other programs.

A DESTINATION that ends in {suffixes} is a file for one trajectory; of several,
each becomes a file in a folder of that name. Any other is a folder for a dataset in the native layout.

The format of the source is detected, or named by --format:
{formats}

Type ids keep their numbers. What they mean differs between families of datasets: 3 is a boundary for deepmind, a
rigid body for lagrangebench, a heated wall for jax-sph. The command prints which family it assumed.
"""

_EXAMPLES = """\
examples:
  nmpm convert datasets/WaterRamps water                 DeepMind's TFRecords
  nmpm convert flume/test.npz flume --types 1=debris --bounds 0.02:1,0:0.2
  nmpm convert heated-channel channel --family jax-sph --boundary periodic,wall
  nmpm convert out.h5 out.vtkhdf                         a rollout for ParaView; .usda: Blender
  nmpm convert water splash.csv --trajectory 3           one trajectory of a dataset, of its tests
  nmpm convert ramps ramps-for-lagrangebench --ids 5=0,3=1   LagrangeBench: 0 fluid, 1 wall
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["convert", "datasets/WaterRamps", "water"]."""
    arguments = _parser().parse_args(words[1:])
    check_at_least("--trajectory", arguments.trajectory, 0)
    options = data_options(arguments)
    ids = parse_option("--ids", arguments.ids, _new_ids, "OLD=NEW pairs of type ids, e.g. 5=0,3=1")
    if _is_file_name(arguments.destination):
        _export(arguments, options, ids)
        return
    if arguments.trajectory is not None or arguments.split is not None:
        raise ConfigError("--trajectory and --split are for a DESTINATION that is a file.")
    from nmpm.data.convert import convert

    check_folder("DESTINATION", arguments.destination)
    for note in convert(arguments.source, arguments.destination, arguments.format, options, ids):
        sys.stdout.write(f"- {note}\n")
    sys.stdout.write(
        f"wrote {arguments.destination}; to look at it: nmpm inspect {shlex.quote(str(arguments.destination))}\n"
    )


def _parser() -> argparse.ArgumentParser:
    from nmpm.data.convert import FORMATS
    from nmpm.data.split_files import SPLITS
    from nmpm.data.write import SUFFIXES

    width = max(len(kind.name) for kind in FORMATS)
    formats = "\n".join(f"  {f.name:<{width}}  {f.summary}" for f in FORMATS)
    parser = CommandParser(
        prog="nmpm convert", description=_DESCRIPTION.format(formats=formats, suffixes=SUFFIXES), epilog=_EXAMPLES
    )
    parser.add_argument("source", type=Path, help="file or folder to read")
    parser.add_argument(
        "destination", type=Path, help=f"folder to write, new or empty; or a file, by its suffix: {SUFFIXES}"
    )
    parser.add_argument("--format", metavar="NAME", help="format of the source (default: detected)")
    parser.add_argument("--ids", metavar="OLD=NEW,...", help="new type ids in the written files, e.g. 5=0,3=1")
    parser.add_argument("--trajectory", type=int, metavar="N", help="write this one to a file (default: all)")
    parser.add_argument("--split", choices=SPLITS, help="of the trajectories (default: all; of one: test)")
    add_data_options(parser)
    return parser


def _is_file_name(destination: Path) -> bool:
    """Whether a name is that of a file; raises ConfigError if it looks like one of a form that is not written."""
    from nmpm.data.write import SUFFIXES, is_written_by_suffix

    if destination.is_dir() or not re.fullmatch(r"\.[a-zA-Z]\w{1,9}", destination.suffix):
        return False
    if not is_written_by_suffix(destination):
        raise ConfigError(
            f"DESTINATION {destination}: nothing is written by that suffix; there are {SUFFIXES}. For a folder of that"
            " name, create it first."
        )
    return True


def _export(arguments: argparse.Namespace, options: Options, ids: dict[int, int] | None) -> None:
    from nmpm.data.convert.conversion import renumber_types
    from nmpm.data.convert.export import export, open_complete
    from nmpm.data.write import find_writer

    writer, source = find_writer("DESTINATION", arguments.destination), arguments.source.resolve()
    if source in (arguments.destination.resolve(), arguments.destination.with_suffix("").resolve()):
        raise ConfigError(f"DESTINATION {arguments.destination}: it would replace the source; choose another name.")
    with open_complete(arguments.source, arguments.format, options) as opened:
        dataset = renumber_types(opened, ids) if ids else opened
        exported = export(dataset, arguments.destination, arguments.split, arguments.trajectory)
    for note in (*dataset.notes, *exported.notes):
        sys.stdout.write(f"- {note}\n")
    if exported.files == 1:
        sys.stdout.write(f"wrote {exported.path}; to look at it: {writer.hint(exported.path)}\n")
    else:
        sys.stdout.write(f"wrote {exported.files} trajectories to {exported.path}, a file each\n")


def _new_ids(text: str) -> dict[int, int]:
    pairs = [pair.split("=") for pair in text.split(",")]
    return {int(old): int(new) for old, new in pairs}
