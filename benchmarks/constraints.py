"""What constraints and the monitor cost a rollout, each beside the free one, in turns within one run.

python benchmarks/constraints.py --zoo goop waterramps --frames 400 --repeats 9
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial

import torch
from turns import in_one_process, processor_time

from nmpm.emulator.constraints import Constraints
from nmpm.emulator.model import Bundle, Emulator
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.emulator.rollouts import rollout
from nmpm.evaluation.stress.subject import Subject
from nmpm.particles import Particles
from nmpm.sim import load_preset
from nmpm.zoo import Zoo

FREE = Constraints(solids=False)


class Timed(Monitor):
    """A monitor that times itself: its share is far below what whole rollouts differ by."""

    spent = 0.0

    def see(self, emulator: Emulator, particles: Particles, bundle: Bundle) -> None:
        start = time.process_time()
        super().see(emulator, particles, bundle)
        self.spent += time.process_time() - start


def watched(emulator: Emulator, state: Particles, frames: int, repeats: int) -> list[float]:
    """Shares of rollouts' time that go into watching them."""
    shares = []
    for _ in range(repeats + 1):
        monitor = Timed(Policy.RECORD)
        whole = processor_time(lambda monitor=monitor: rollout(emulator, state, frames, monitor))
        shares.append(monitor.spent / (whole - monitor.spent))
    return shares[1:]


def measure(name: str, frames: int, repeats: int) -> None:
    """Print ratios for a zoo model, on one scene of its simulator."""
    emulator = Zoo.load(name).emulator
    state = Subject(name, emulator, 32, load_preset(name)).starts(1)
    forms: dict[str, Callable[[], object]] = {}

    def form(constraints: Constraints) -> Callable[[], object]:
        return partial(rollout, emulator.with_constraints(constraints), state, frames)

    held = dataclasses.replace(FREE, energy=True, rest_speed=0.01, solids=True)
    forms["free"] = form(FREE)
    forms["energy"] = form(dataclasses.replace(FREE, energy=True))
    forms["rest"] = form(dataclasses.replace(FREE, rest_speed=0.01))
    forms["solids"] = form(dataclasses.replace(FREE, solids=True))
    forms["all"] = form(held)
    seconds = in_one_process(forms, repeats, processor_time)
    bundles = -(-frames // emulator.frames)
    for key, values in seconds.items():
        ratios = [value / free for value, free in zip(values, seconds["free"], strict=True)]
        call = 1e3 * statistics.median(values) / bundles
        sys.stdout.write(
            f"{name:<12}{key:<16}{call:6.2f} ms/call   {statistics.median(ratios):.3f} of free"
            f" ({min(ratios):.3f}-{max(ratios):.3f})\n"
        )
    shares = watched(emulator, state, frames, repeats)
    sys.stdout.write(f"{name:<12}watching adds {statistics.median(shares):.2%} ({min(shares):.2%}-{max(shares):.2%})\n")


def main() -> None:
    """Measure each model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zoo", nargs="+", default=["goop", "waterramps"])
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--repeats", type=int, default=9)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    for name in chosen.zoo:
        measure(name, chosen.frames, chosen.repeats)


if __name__ == "__main__":
    main()
