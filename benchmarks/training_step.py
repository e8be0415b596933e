"""Time a training step of the paper's form and of ours, alternating: steps per second, and GFLOP/s reached.

python benchmarks/training_step.py --device cpu                 batch 16, 64 channels, K = 4, m = 8
python benchmarks/training_step.py --device cuda --batch 128 --rounds 50          the paper's recipe on a GPU
python benchmarks/training_step.py --json step.json
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import torch
from timing import Spread, describe_machine, measure_limits, time_in_processes, write_json
from torch.utils.flop_counter import FlopCounterMode
from workloads import SETUPS, TrainingStep, make_setups_parser


def count_gflop(name: str, options: dict[str, Any]) -> float:
    """GFLOP of the network in one step of a setup, forwards and backwards, counted on a batch of one on the CPU."""
    step = TrainingStep(SETUPS[name], **options | {"batch": 1, "device": torch.device("cpu")})
    with FlopCounterMode(display=False) as counter:
        step()
    return float(1e-9 * counter.get_total_flops() * options["batch"])


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = make_setups_parser(__doc__, batch=16)
    parser.add_argument("--unroll", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=7)
    chosen = parser.parse_args()
    names = ("preset", "particles", "batch", "width", "unroll", "device")
    options = {name: getattr(chosen, name) for name in names}
    machine = describe_machine(chosen.device, chosen.threads)
    limits = measure_limits(chosen.device, chosen.threads)
    makers = {name: partial(TrainingStep, setup, **options) for name, setup in SETUPS.items()}
    runs = time_in_processes(makers, chosen.rounds, chosen.threads)
    seconds = {name: Spread.of(values) for name, values in runs.items()}
    sys.stdout.write(f"{machine}; {options | {'device': str(chosen.device)}}; reached at most: {limits}\n")
    first = next(iter(seconds.values())).median
    rows = {}
    for name, spread in seconds.items():
        gflop = count_gflop(name, options)
        rows[name] = {"seconds": spread, "times_the_first": first / spread.median, "gflop": gflop}
        sys.stdout.write(
            f"{name:<40}{spread.format():>26} ms  {1 / spread.median:8.3f} steps/s  {first / spread.median:5.2f} x"
            f"  {gflop:8.1f} GFLOP  {gflop / spread.median:8.0f} GFLOP/s\n"
        )
    write_json(chosen.json, {"machine": machine, "options": options, "limits": limits, "setups": rows})


if __name__ == "__main__":
    main()
