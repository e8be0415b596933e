"""Calls of a rollout (p2g, network, m times g2p and advection), the paper's form and ours, in turns.

python benchmarks/rollout_call.py                            on the CPU, one scene of 2,300 particles
python benchmarks/rollout_call.py --batch 128 --device cuda  many scenes on a GPU
python benchmarks/rollout_call.py --json call.json
"""

from __future__ import annotations

import sys
from functools import partial

from forms import FORMS, FRAMES, Rolling, form_arguments
from turns import Spread, in_turns, machine, write


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = form_arguments(__doc__, batch=1)
    parser.add_argument("--calls", type=int, default=10, help="calls per timed run (default: 10)")
    parser.add_argument("--rounds", type=int, default=15)
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
