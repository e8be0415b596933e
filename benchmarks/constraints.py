"""What constraints and the monitor cost: rollouts of a zoo model with each, beside unconstrained ones, alternating.

python benchmarks/constraints.py --zoo goop waterramps --frames 400 --repeats 9

CPU time on the CPU, wall time on a GPU.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from functools import partial

import torch
from timing import Clock, add_device_option, clock_for, make_parser, time_alternating, time_run

from nmpm.emulator import Bundle, Emulator, rollout
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.evaluation.stress import ModelUnderTest
from nmpm.particles import Particles
from nmpm.sim import load_preset
from nmpm.zoo import Zoo


class TimedMonitor(Monitor):
    """A monitor that adds up its own time, which is too short to show in the difference of two rollouts.

    Args:
        clock: Reads the time.
    """

    def __init__(self, clock: Clock) -> None:
        super().__init__(Policy.RECORD)
        self.clock, self.seconds = clock, 0.0

    def see(self, emulator: Emulator, particles: Particles, bundle: Bundle) -> None:
        """Look at a bundle, and count the time."""
        self.seconds += time_run(partial(super().see, emulator, particles, bundle), self.clock)


def measure_monitor(emulator: Emulator, state: Particles, frames: int, repeats: int) -> list[float]:
    """The monitor's time over that of the rest of a rollout, for each repeat."""
    clock, shares = clock_for(emulator.device), []
    for _ in range(repeats + 1):
        monitor = TimedMonitor(clock)
        seconds = time_run(partial(rollout, emulator, state, frames, monitor), clock)
        shares.append(monitor.seconds / (seconds - monitor.seconds))
    return shares[1:]


def measure_model(name: str, frames: int, repeats: int, device: torch.device) -> None:
    """Print ratios for a zoo model, on one scene of its simulator."""
    emulator = Zoo.load(name, device=device).emulator
    state = ModelUnderTest(name, emulator, 32, load_preset(name)).starts(1)

    def roll_out(constraints: Constraints) -> Callable[[], object]:
        return partial(rollout, emulator.with_constraints(constraints), state, frames)

    rollouts = {
        "free": roll_out(Constraints(solids=False)),
        "energy": roll_out(Constraints(energy=True, solids=False)),
        "rest": roll_out(Constraints(rest_speed=0.01, solids=False)),
        "solids": roll_out(Constraints(solids=True)),
        "cap": roll_out(Constraints(density_cap=emulator.constraints.density_cap or 1.0, solids=False)),
        "all": roll_out(Constraints(energy=True, rest_speed=0.01, solids=True)),
    }
    seconds = time_alternating(rollouts, repeats, clock_for(device))
    bundles = -(-frames // emulator.frames)
    for key, values in seconds.items():
        ratios = [value / free for value, free in zip(values, seconds["free"], strict=True)]
        call = 1e3 * statistics.median(values) / bundles
        sys.stdout.write(
            f"{name:<12}{key:<16}{call:6.2f} ms/call   {statistics.median(ratios):.3f} of free"
            f" ({min(ratios):.3f}-{max(ratios):.3f})\n"
        )
    shares = measure_monitor(emulator, state, frames, repeats)
    sys.stdout.write(f"{name:<12}monitor adds {statistics.median(shares):.2%} ({min(shares):.2%}-{max(shares):.2%})\n")


def main() -> None:
    """Measure each model."""
    parser = make_parser(__doc__)
    parser.add_argument("--zoo", nargs="+", default=["goop", "waterramps"])
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--repeats", type=int, default=9)
    add_device_option(parser)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    for name in chosen.zoo:
        measure_model(name, chosen.frames, chosen.repeats, chosen.device)


if __name__ == "__main__":
    main()
