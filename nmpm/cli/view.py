"""`nmpm view out.h5 [truth.h5]`: a page that plays trajectories in a browser."""

from __future__ import annotations

import sys
from pathlib import Path

from nmpm.cli.options import CommandParser, add_split_option, check_at_least, check_exists, derived_name

_EXAMPLES = """\
examples:
  nmpm view out.h5                                     a rollout, beside the recording of its --data
  nmpm view out.h5 data/test.h5 --truth-trajectory 3   beside another one with the same start
  nmpm view data/test.h5 --trajectory 7 --every 2      a recorded trajectory, every second frame
  nmpm view tracks.csv --split train                   data of another program

The page needs no network and no nmpm: send it to anybody. Space plays, ? shows the keys.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["view", "out.h5", "truth.h5"]."""
    parser = CommandParser(
        prog="nmpm view",
        description="Write a self-contained HTML page that plays a trajectory, or two beside each other. Of a rollout"
        " with --members it shows all members: faint, as density, or one by one, and bands of height, front, energy.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("file", type=Path, help="a rollout, or data of any format that nmpm inspect reads")
    parser.add_argument("truth", type=Path, nargs="?", help="what FILE should be; errors are against it")
    parser.add_argument(
        "--trajectory",
        type=int,
        default=0,
        help="index in FILE (default: 0, the first); of several members, the one that is drawn in full",
    )
    add_split_option(parser, "FILE")
    parser.add_argument("--truth-trajectory", type=int, help="index in TRUTH (default: that of --trajectory)")
    parser.add_argument("--every", type=int, default=1, help="show every so many frames (default: 1, all)")
    parser.add_argument("--family", help="meaning of type ids if metadata.json lacks it: deepmind, lagrangebench")
    parser.add_argument("--out", type=Path, help="page to write (default: FILE with the suffix .html)")
    arguments = parser.parse_args(words[1:])
    check_at_least("--every", arguments.every, 1)
    for name, path in (("FILE", arguments.file), ("TRUTH", arguments.truth)):
        if path is not None:
            check_exists(name, path)
    from nmpm.viz.output import check_output

    out = arguments.out or derived_name(arguments.file, ".html")
    check_output(out, (".html",))
    from nmpm.data.convert import Options, native_file
    from nmpm.viz.viewer import page_of_files

    truth_index = arguments.trajectory if arguments.truth_trajectory is None else arguments.truth_trajectory
    truth = (arguments.truth, truth_index) if arguments.truth else None
    shown = (native_file(arguments.file, arguments.split, Options(family=arguments.family)), arguments.trajectory)
    page = page_of_files(shown, truth, arguments.every, arguments.family)
    page.write(out)
    size = out.stat().st_size / 1e6
    sys.stdout.write(f"wrote {out} ({size:.1f} MB): open it in a browser\n")
