"""A training step of the paper's form and of ours, in turns: iterations per second, and what of the machine they use.

python benchmarks/training_step.py                              on the CPU: batch 16, 64 channels, K = 4, m = 8
python benchmarks/training_step.py --device cuda --batch 128 --rounds 50          the paper's recipe on a GPU
python benchmarks/training_step.py --json step.json
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

from forms import FORMS, Training, form_arguments
from torch.utils.flop_counter import FlopCounterMode
from turns import Spread, ceilings, in_turns, machine, write


def flop(name: str, options: dict[str, Any]) -> float:
    """GFLOP of the network in one step of a form, forwards and backwards, counted on a batch of one on the CPU."""
    one = Training(FORMS[name], **options | {"batch": 1, "device": "cpu"})
    with FlopCounterMode(display=False) as counter:
        one()
    return float(1e-9 * counter.get_total_flops() * options["batch"])


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = form_arguments(__doc__, batch=16)
    parser.add_argument("--unroll", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=7)
    chosen = parser.parse_args()
    names = ("preset", "particles", "batch", "width", "unroll", "device")
    options = {name: getattr(chosen, name) for name in names}
    limits = ceilings(chosen.device, chosen.threads)
    makers = {name: partial(Training, form, **options) for name, form in FORMS.items()}
    seconds = {name: Spread.of(runs) for name, runs in in_turns(makers, chosen.rounds, chosen.threads).items()}
    sys.stdout.write(f"{machine(chosen.device, chosen.threads)}; {options}; reached at most: {limits}\n")
    first = next(iter(seconds.values())).median
    rows = {}
    for name, spread in seconds.items():
        work = flop(name, options)
        rows[name] = {"seconds": spread, "times_the_first": first / spread.median, "gflop": work}
        sys.stdout.write(
            f"{name:<40}{spread.shown():>26} ms  {1 / spread.median:8.3f} steps/s  {first / spread.median:5.2f} x"
            f"  {work:8.1f} GFLOP  {work / spread.median:8.0f} GFLOP/s\n"
        )
    write(chosen.json, {"machine": machine(chosen.device, chosen.threads), "options": options, "limits": limits,
                        "forms": rows})  # fmt: skip


if __name__ == "__main__":
    main()
