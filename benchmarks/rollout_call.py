"""Calls of a rollout (p2g, network, m times g2p and advection), the paper's form and ours, in turns.

python benchmarks/rollout_call.py                            on the CPU, one scene of 2,300 particles
python benchmarks/rollout_call.py --batch 128 --device cuda  many scenes on a GPU
python benchmarks/rollout_call.py --json call.json
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import torch
from forms import FORMS, FRAMES, Rolling
from turns import Spread, in_turns, machine, write


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--preset", default="waterramps")
    parser.add_argument("--particles", type=int, default=2300)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--calls", type=int, default=10, help="calls per timed run (default: 10)")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    chosen = parser.parse_args()
    options = {name: getattr(chosen, name) for name in ("preset", "particles", "batch", "width", "calls", "device")}
    makers = {name: partial(Rolling, form, **options) for name, form in FORMS.items()}
    seconds = in_turns(makers, chosen.rounds, chosen.threads)
    sys.stdout.write(f"{machine(chosen.device, chosen.threads)}; {options}, {FRAMES} frames a call\n")
    spreads = {name: Spread.of([run / chosen.calls for run in runs]) for name, runs in seconds.items()}
    first = next(iter(spreads.values())).median
    for name, spread in spreads.items():
        frames = chosen.batch * FRAMES / spread.median
        sys.stdout.write(
            f"{name:<40}{spread.shown():>26} ms a call  {frames:10.0f} frames/s  {first / spread.median:5.2f} x\n"
        )
    write(chosen.json, {"machine": machine(chosen.device, chosen.threads), "options": options, "seconds": spreads})


if __name__ == "__main__":
    main()
