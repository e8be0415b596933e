"""`nmpm view out.h5 [truth.h5]`: a page that plays trajectories in a browser."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from nmpm.cli.options import HelpFormatter, check_at_least, check_input

_EXAMPLES = """\
examples:
  nmpm view out.h5                                     a rollout, beside the recording of its --data
  nmpm view out.h5 data/test.h5 --truth-trajectory 3   beside another one with the same start
  nmpm view data/test.h5 --trajectory 7 --every 2      a recorded trajectory, every second frame

The page needs no network and no nmpm: send it to anybody. Space plays, ? shows the keys.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["view", "out.h5", "truth.h5"]."""
    parser = argparse.ArgumentParser(
        prog="nmpm view",
        description="Write a self-contained HTML page that plays a trajectory, or two beside each other.",
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("file", type=Path, help="HDF5 file of nmpm rollout or of a dataset in native format")
    parser.add_argument("truth", type=Path, nargs="?", help="HDF5 file of what FILE should be; errors are against it")
    parser.add_argument("--trajectory", type=int, default=0, help="index in FILE (default: 0, the first)")
    parser.add_argument("--truth-trajectory", type=int, help="index in TRUTH (default: that of --trajectory)")
    parser.add_argument("--every", type=int, default=1, help="show every so many frames (default: 1, all)")
    parser.add_argument("--family", help="meaning of type ids if metadata.json lacks it: deepmind, lagrangebench")
    parser.add_argument("--out", type=Path, help="page to write (default: FILE with the suffix .html)")
    arguments = parser.parse_args(words[1:])
    check_at_least("--every", arguments.every, 1)
    for name, path in (("FILE", arguments.file), ("TRUTH", arguments.truth)):
        if path is not None:
            check_input(name, path)
    from nmpm.viz.output import check_output

    out = arguments.out or arguments.file.with_suffix(".html")
    check_output(out, (".html",))
    from nmpm.viz.viewer import page_of_files

    truth_index = arguments.trajectory if arguments.truth_trajectory is None else arguments.truth_trajectory
    truth = (arguments.truth, truth_index) if arguments.truth else None
    page = page_of_files((arguments.file, arguments.trajectory), truth, arguments.every, arguments.family)
    page.write(out)
    size = out.stat().st_size / 1e6
    sys.stdout.write(f"wrote {out} ({size:.1f} MB): open it in a browser\n")
