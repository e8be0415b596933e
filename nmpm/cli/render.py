"""`nmpm render out.h5 [truth.h5]`: PNG and GIF or MP4 of a trajectory, or of two beside each other."""

from __future__ import annotations

import sys
from pathlib import Path

from nmpm._support.messages import install
from nmpm.cli.options import CommandParser, add_split_option, add_style_option, check_exists, derived_name
from nmpm.errors import ConfigError

_EXAMPLES = """\
examples:
  nmpm render out.h5                        a rollout of nmpm rollout: out.png and out.gif
  nmpm render out.h5 truth.h5               beside another trajectory with the same start
  nmpm render out.h5 --mp4 --out splash     splash.png and splash.mp4
  nmpm render out.h5 --style talk           out.svg for slides, with three frames; paper: out.pdf
  nmpm render data/test.h5 --trajectory 7   a recorded trajectory: data/test.png and data/test.gif
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["render", "out.h5"]."""
    parser = CommandParser(
        prog="nmpm render",
        description="Draw a trajectory, or two beside each other: PNG, and GIF or MP4. Of a rollout with --members it"
        " draws one over the share of members that are at each place, and bands of height, front and energy.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("file", type=Path, help="a rollout, or data of any format that nmpm inspect reads")
    parser.add_argument("truth", type=Path, nargs="?", help="what FILE should be; errors are against it")
    add_split_option(parser, "FILE")
    parser.add_argument("--truth-trajectory", type=int, help="index in TRUTH (default: that of --trajectory)")
    parser.add_argument(
        "--trajectory",
        type=int,
        default=0,
        help="index of the trajectory (default: 0, the first); of several members, the one that is drawn in full",
    )
    parser.add_argument("--family", help="meaning of type ids if metadata.json lacks it: deepmind, lagrangebench")
    add_style_option(parser, "the snapshots, in place of the PNG,")
    parser.add_argument("--mp4", action="store_true", help=f"an MP4 in place of the GIF ({install('video')})")
    parser.add_argument("--out", type=Path, help="path of the pictures without suffix (default: that of the file)")
    arguments = parser.parse_args(words[1:])
    from nmpm.data.convert import Options, native_file
    from nmpm.data.format import Split
    from nmpm.viz import write_animation, write_snapshots
    from nmpm.viz.files import combine, read_labelled
    from nmpm.viz.output import STYLES, check_output

    stem = arguments.out or derived_name(arguments.file, "")
    style = STYLES.get(arguments.style)
    suffix, columns = (style.suffix, style.columns) if style else (".png", 6)
    picture = stem.with_name(stem.name + suffix)
    video = stem.with_name(f"{stem.name}{'.mp4' if arguments.mp4 else '.gif'}")
    for name, path in (("FILE", arguments.file), ("TRUTH", arguments.truth)):
        if path is not None:
            check_exists(name, path)
    split = Split(native_file(arguments.file, arguments.split, Options(family=arguments.family)))
    if not 0 <= arguments.trajectory < len(split):
        raise ConfigError(
            f"--trajectory {arguments.trajectory}: {arguments.file} contains trajectories 0 … {len(split) - 1}."
        )
    check_output(picture, (suffix,))
    check_output(video, (".gif", ".mp4"))
    trajectories = read_labelled(split, arguments.trajectory, arguments.family)
    if arguments.truth is not None:
        index = arguments.trajectory if arguments.truth_trajectory is None else arguments.truth_trajectory
        truth = read_labelled(Split(native_file(arguments.truth)), index, arguments.family)
        trajectories = combine(truth, trajectories, (str(arguments.truth), str(arguments.file)))
    for path in (write_snapshots(trajectories, picture, columns), write_animation(trajectories, video)):
        sys.stdout.write(f"wrote {path}\n")
