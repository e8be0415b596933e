"""`nmpm compare MODEL… --data DATASET`: `nmpm trade` with a sweep of its own, in which models are what varies."""

from __future__ import annotations

from pathlib import Path

from nmpm.cli.options import MODEL, CommandParser, check_data
from nmpm.cli.trade import add_scene_options, measure_and_report

DESCRIPTION = """Compare models on test scenes that they need not have been trained on: other particle counts, other
obstacles, a wider domain, other units. A model of other scenes keeps its weights, and gets a grid over their domain on
which they are, in cells and frames, like those of its training. Beside the models stand trivial predictors and, for
simulated scenes, the simulator's time and what its own results are uncertain by."""

_EXAMPLES = """\
examples:
  nmpm compare waterramps waterdrop --data waterdrop-xl   for four times as many particles?
  nmpm compare waterramps --data waterramps --wider 2     ... in a domain twice as wide?
  nmpm compare goop runs/mine --data goop --scenes 30     your own model beside the zoo's
  nmpm compare sandramps multimaterial --data FOLDER --materials big=sand,small=sand
                                                          on recorded data of any form

It prints a table, and writes to the folder of --out the files of nmpm trade: compare.csv, compare.md, compare.json (all
figures, of every scene), compare.png (error against time), errors.png (error against frames), frames.png (the first
scene's splash and last frame, side by side), and points/, which holds every measurement: with one more model, the same
command measures only what is new. Scenes of another gravity, time between frames or material are matched: a model takes
them in cells and at a stride that make them like its own, which a line below the table states. --strict refuses what
cannot be matched.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["compare", "waterramps", "--data", "waterdrop-xl"]."""
    parser = CommandParser(prog="nmpm compare", description=DESCRIPTION, epilog=_EXAMPLES)
    parser.add_argument("models", nargs="+", metavar="MODEL", help=MODEL)
    parser.add_argument(
        "--data", required=True, metavar="DATASET", help="an embedded dataset (goop, …), or a file or folder of data"
    )
    add_scene_options(parser, "compare", scenes=6)
    parser.set_defaults(times=True, config=None, predictors=[], members=None)
    options = parser.parse_args(words[1:])
    check_data("--data", Path(options.data))
    measure_and_report("compare", options, options.data)
