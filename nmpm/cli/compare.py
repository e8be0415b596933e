"""`nmpm compare MODEL… --data DATASET`: `nmpm trade` with a sweep of its own, in which models are what varies."""

from __future__ import annotations

import argparse

from nmpm.cli.options import MODEL, HelpFormatter
from nmpm.cli.trade import add_scene_options, measure_and_report

DESCRIPTION = """Compare models on test scenes that they need not have been trained on: other particle counts, other
obstacles, a wider domain. A model of other scenes keeps its weights, and gets a grid over their domain with cells of
the size it was trained with. Beside the models stand trivial predictors and, for simulated scenes, the simulator's time
and what its own results are uncertain by."""

_EXAMPLES = """\
examples:
  nmpm compare waterramps waterdrop --data waterdrop-xl   for four times as many particles?
  nmpm compare waterramps --data waterramps --wider 2     ... in a domain twice as wide?
  nmpm compare goop runs/mine --data goop --scenes 30     your own model beside the zoo's
  nmpm compare runs/a runs/b --data FOLDER                on recorded data in native layout

It prints a table, and writes to the folder of --out the files of nmpm trade: compare.csv, compare.md, compare.json (all
figures, of every scene), compare.png (error against time), errors.png (error against frames), frames.png (the first
scene's splash and last frame, side by side), and points/, which holds every measurement: with one more model, the same
command measures only what is new. A model can predict scenes with the same materials, gravity, time between frames and
kinds of boundary as its own; others are refused by name.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["compare", "waterramps", "--data", "waterdrop-xl"]."""
    parser = argparse.ArgumentParser(
        prog="nmpm compare", description=DESCRIPTION, epilog=_EXAMPLES, formatter_class=HelpFormatter
    )
    parser.add_argument("models", nargs="+", metavar="MODEL", help=MODEL)
    parser.add_argument(
        "--data", required=True, metavar="DATASET", help="an embedded dataset (goop, …), or a folder in native layout"
    )
    add_scene_options(parser, "compare", scenes=6)
    parser.set_defaults(config=None, predictors=[])
    options = parser.parse_args(words[1:])
    measure_and_report("compare", options, options.data)
