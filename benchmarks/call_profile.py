"""What a call of a shipped model spends its time on: the network, the kernels around it, and what joins them.

python benchmarks/call_profile.py --threads 1 --models goop waterramps --json call_profile.json

Each part is called by itself, in turn with the others and with the whole call, 20 bundles into a rollout of a scene of
the model's own; CPU time in µs, least, median (quartiles) over the rounds. "Rest" is a call without its network and
without the kernels: Python and torch between them. The kernels' own time contains the conversion of tensors to arrays.
Beside it stand the files and functions of the package that a call runs through.
"""

from __future__ import annotations

import copy
import statistics
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from timing import clock_for, describe_machine, make_timing_parser, time_alternating, write_json

import nmpm
from nmpm.emulator import Emulator, RolloutContext
from nmpm.emulator.engines import find_engine
from nmpm.evaluation.stress.model import ModelUnderTest
from nmpm.particles import Particles
from nmpm.sim import load_preset
from nmpm.zoo import Zoo

PACKAGE = str(Path(nmpm.__file__).parent)
CALL = "call"
NETWORK = "network"
BUNDLES = 20


@torch.no_grad()
def late_state(emulator: Emulator, name: str) -> tuple[Particles, RolloutContext]:
    """A scene of the model's own, `BUNDLES` bundles into its rollout, and what the rollout knows of its start."""
    particles = ModelUnderTest(name, emulator, 32, load_preset(name)).starts(1)
    context = emulator.context(particles)
    for _ in range(BUNDLES):
        particles = emulator(particles, context).state_after(particles)
    return particles, context


def split_call(emulator: Emulator, particles: Particles, context: RolloutContext) -> dict[str, Callable[[], object]]:
    """The whole call, and each of its parts on the values that the call gives it."""
    engine = find_engine(emulator, particles, context.solid)
    start = engine.rasterise(particles, context)
    seen = engine.normalise(start, context)
    output = engine.network(seen)
    flight = engine.fly(start, output, context)
    return {
        CALL: lambda: emulator(particles, context),
        NETWORK: lambda: engine.network(seen),
        "rasterise": lambda: engine.rasterise(particles, context),
        "normalise": lambda: engine.normalise(start, context),
        "fly": lambda: engine.fly(start, output, context),
        "spread and land": lambda: engine.land(start, engine.spread(start, copy.deepcopy(flight), context)),
    }


def count_operations(action: Callable[[], object]) -> int:
    """Operations of torch that an action dispatches, those within others included."""
    with torch.profiler.profile() as profile:
        action()
    return sum(event.count for event in profile.key_averages())


def count_code(action: Callable[[], object]) -> tuple[int, int]:
    """Files and functions of the package that an action runs through."""
    seen: set[tuple[str, str]] = set()

    def see(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            seen.add((frame.f_code.co_filename, frame.f_code.co_qualname))

    sys.setprofile(see)
    try:
        action()
    finally:
        sys.setprofile(None)
    return len({file for file, _ in seen}), len(seen)


def summarise(seconds: Mapping[str, list[float]]) -> dict[str, Any]:
    """Least and quartiles of each part in µs, and of what is left of a call in the same round."""
    rest = [2 * call - sum(values) for call, *values in zip(seconds[CALL], *seconds.values(), strict=True)]
    around = [call - network for call, network in zip(seconds[CALL], seconds[NETWORK], strict=True)]
    figures = {**seconds, "rest": rest, "all but the network": around}
    return {
        name: [1e6 * value for value in (min(values), *statistics.quantiles(values))]
        for name, values in figures.items()
    }


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--models", nargs="+", default=["goop", "waterramps"])
    parser.add_argument("--rounds", type=int, default=60)
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    sys.stdout.write(f"{describe_machine(chosen.device, chosen.threads)}; µs, least, median (quartiles)\n")
    found: dict[str, Any] = {}
    for name in chosen.models:
        emulator = Zoo.load(name).emulator.to(chosen.device)
        state, context = late_state(emulator, name)
        with torch.no_grad():
            parts = split_call(emulator, state, context)
            found[name] = summarise(time_alternating(parts, chosen.rounds, clock_for(chosen.device)))
            files, functions = count_code(parts[CALL])
            around = count_operations(parts[CALL]) - count_operations(parts[NETWORK])
        sys.stdout.write(
            f"{name}, {state.position.shape[1]} particles; {around} operations of torch around its network;"
            f" {functions} functions in {files} files\n"
        )
        for part, (least, low, middle, high) in found[name].items():
            sys.stdout.write(f"  {part:<34}{least:8.0f}{middle:8.0f} ({low:.0f}-{high:.0f})\n")
    write_json(chosen.json, found)


if __name__ == "__main__":
    main()
