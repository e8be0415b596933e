"""Time a rollout's calls (p2g, network, m times g2p and advection): the paper's form and ours, alternating.

python benchmarks/rollout_call.py --device cpu               one scene of 2,300 particles
python benchmarks/rollout_call.py --batch 128 --device cuda  many scenes on a GPU
python benchmarks/rollout_call.py --json call.json
"""

from __future__ import annotations

import sys
from functools import partial

from timing import Spread, describe_machine, time_in_processes, write_json
from workloads import FRAMES, SETUPS, RolloutCalls, make_setups_parser


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = make_setups_parser(__doc__, batch=1)
    parser.add_argument("--calls", type=int, default=10, help="calls per timed run (default: 10)")
    parser.add_argument("--rounds", type=int, default=15)
    chosen = parser.parse_args()
    machine = describe_machine(chosen.device, chosen.threads)
    options = {name: getattr(chosen, name) for name in ("preset", "particles", "batch", "width", "calls", "device")}
    makers = {name: partial(RolloutCalls, setup, **options) for name, setup in SETUPS.items()}
    seconds = time_in_processes(makers, chosen.rounds, chosen.threads)
    sys.stdout.write(f"{machine}; {options | {'device': str(chosen.device)}}, {FRAMES} frames a call\n")
    spreads = {name: Spread.of([run / chosen.calls for run in runs]) for name, runs in seconds.items()}
    first = next(iter(spreads.values())).median
    for name, spread in spreads.items():
        frames = chosen.batch * FRAMES / spread.median
        sys.stdout.write(
            f"{name:<40}{spread.format():>26} ms a call  {frames:10.0f} frames/s  {first / spread.median:5.2f} x\n"
        )
    write_json(chosen.json, {"machine": machine, "options": options, "seconds": spreads})


if __name__ == "__main__":
    main()
