"""`nmpm convert SOURCE DESTINATION`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from nmpm.cli.options import HelpFormatter, add_data_options, check_folder, data_options, new_ids

_DESCRIPTION = """\
Bring a dataset of another format into the native layout (LagrangeBench's HDF5 files with a metadata.json).

The format is detected, or named by --format:
{formats}

Type ids keep their numbers. What they mean differs between families of datasets: 3 is a boundary for deepmind, a
rigid body for lagrangebench, a heated wall for jax-sph. The command prints which family it assumed.
"""

_EXAMPLES = """\
examples:
  nmpm convert datasets/WaterRamps water                 DeepMind's TFRecords
  nmpm convert flume/test.npz flume --types 1=debris --bounds 0.02:1,0:0.2
  nmpm convert heated-channel channel --family jax-sph --boundary periodic,wall
  nmpm convert ramps ramps-for-lagrangebench --ids 5=0,3=1   LagrangeBench: 0 fluid, 1 wall
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["convert", "datasets/WaterRamps", "water"]."""
    from nmpm.data.convert import FORMATS, convert

    width = max(len(kind.name) for kind in FORMATS)
    parser = argparse.ArgumentParser(
        prog="nmpm convert",
        description=_DESCRIPTION.format(formats="\n".join(f"  {f.name:<{width}}  {f.summary}" for f in FORMATS)),
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("source", type=Path, help="file or folder to read")
    parser.add_argument("destination", type=Path, help="folder to write; must not exist yet, or be empty")
    parser.add_argument("--format", metavar="NAME", help="format of the source (default: detected)")
    parser.add_argument("--ids", metavar="OLD=NEW,...", help="new type ids in the written files, e.g. 5=0,3=1")
    add_data_options(parser)
    arguments = parser.parse_args(words[1:])
    check_folder("DESTINATION", arguments.destination)
    options, ids = data_options(arguments), new_ids(arguments.ids)
    for note in convert(arguments.source, arguments.destination, arguments.format, options, ids):
        sys.stdout.write(f"- {note}\n")
    sys.stdout.write(f"wrote {arguments.destination}; to look at it: nmpm inspect {arguments.destination}\n")
