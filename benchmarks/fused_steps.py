"""Time calls with the fused kernels and with tensor operations, alternating, and the network's share of each.

python benchmarks/fused_steps.py --zoo goop waterramps            calls of zoo models, 20 bundles into a rollout
python benchmarks/fused_steps.py --particles 1e4 1e5 1e6          one scene on 64 x 64 cells, no constraints

CPU time. "around" is a call without its network.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from scaling import build_case
from timing import Spread, describe_machine, make_timing_parser, write_json

from nmpm.emulator import Emulator
from nmpm.evaluation.stress import ModelUnderTest
from nmpm.particles import Particles
from nmpm.sim import load_preset
from nmpm.transfer import without_kernels
from nmpm.zoo import Zoo

PATHS: dict[str, Callable[[], AbstractContextManager[None]]] = {
    "kernels": nullcontext,
    "tensor operations": lambda: without_kernels(),
}


class TimedNetwork(torch.nn.Module):
    """A network that adds up its own time."""

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.network, self.seconds = network, 0.0

    def forward(self, grid: torch.Tensor) -> torch.Tensor:
        """The network's output."""
        start = time.process_time()
        output: torch.Tensor = self.network(grid)
        self.seconds += time.process_time() - start
        return output


@torch.inference_mode()
def measure(emulator: Emulator, state: Particles, bundles: int, rounds: int) -> dict[str, dict[str, Spread]]:
    """Seconds of a call and of all but its network, by path, after some bundles of a rollout."""
    network = TimedNetwork(emulator.processor)
    emulator.processor = network  # type: ignore[assignment]
    context = emulator.context(state)
    for _ in range(bundles):
        bundle = emulator(state, context)
        state = state.with_motion(bundle.position[:, -1].clone(), bundle.velocity)
    seconds: dict[str, dict[str, list[float]]] = {name: {"call": [], "around": []} for name in PATHS}
    for turn in range(rounds + 2):
        for name, choose in PATHS.items():
            with choose():
                network.seconds, start = 0.0, time.process_time()
                emulator(state, context)
                spent = time.process_time() - start
            if turn > 1:
                seconds[name]["call"].append(spent)
                seconds[name]["around"].append(spent - network.seconds)
    return {name: {part: Spread.of(values) for part, values in parts.items()} for name, parts in seconds.items()}


def main() -> None:
    """Measure, print a line for each, and write JSON if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--zoo", nargs="*", default=["goop", "waterramps"])
    parser.add_argument("--particles", type=float, nargs="*", default=[])
    parser.add_argument("--bundles", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=30)
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    sys.stdout.write(f"{describe_machine(torch.device('cpu'), chosen.threads)}; CPU time, ms\n")
    figures: dict[str, Any] = {}
    for name in chosen.zoo:
        emulator = Zoo.load(name).with_network("bfloat16").emulator
        state = ModelUnderTest(name, emulator, 32, load_preset(name)).starts(1)
        figures[name] = measure(emulator, state, chosen.bundles, chosen.rounds)
        figures[f"{name}, unconstrained"] = measure(
            Zoo.load(name).with_network("bfloat16").emulator.unconstrained(), state, chosen.bundles, chosen.rounds
        )
    for count in map(round, chosen.particles):
        figures[f"{count} particles"] = measure(*build_case(count, (64, 64)), 0, min(chosen.rounds, 5))
    for what, paths in figures.items():
        for path, parts in paths.items():
            texts = (f"{part} {spread.format():>26}" for part, spread in parts.items())
            sys.stdout.write(f"{what:<28}{path:<20}{'  '.join(texts)}\n")
    write_json(chosen.json, figures)


if __name__ == "__main__":
    main()
