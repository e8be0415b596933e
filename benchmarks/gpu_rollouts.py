"""Time rollouts of zoo models on a device, operation by operation and as CUDA graphs, alternating.

python benchmarks/gpu_rollouts.py --device cuda
python benchmarks/gpu_rollouts.py --device cuda --zoo goop wbcsph --batches 1 64 --json gpu_rollouts.json

A thrown block of as many particles as the model's test scenes have, so many times per batch. Milliseconds per frame of
one scene, median and range. On a CPU, which has no graphs, rollouts go operation by operation only.
"""

from __future__ import annotations

import sys
from functools import partial

import torch
from timing import Spread, describe_machine, make_timing_parser, time_alternating, write_json

from nmpm.emulator import Emulator, rollout
from nmpm.zoo import Pretrained, Zoo
from nmpm.zoo.speed import repeat_scene, thrown_scene

BUNDLES = 4
"""Calls of the network in each timed rollout."""


def make_forms(model: Pretrained, device: torch.device) -> dict[str, Emulator]:
    """The emulator by each runtime of the device."""
    graphs = {"cuda-graph": model.optimized("cuda-graph").emulator} if device.type == "cuda" else {}
    return {"eager": model.emulator, **graphs}


def time_model(name: str, batches: list[int], rounds: int, device: torch.device) -> dict[str, object]:
    """Print and return a model's times by runtime and batch."""
    model = Zoo.load(name, device=device)
    one = thrown_scene(model)
    count = one.position.shape[1]
    forms, figures = make_forms(model, device), {}
    frames = BUNDLES * model.emulator.frames
    for batch in batches:
        state = repeat_scene(one, batch)
        runs = {form: partial(rollout, emulator, state, frames) for form, emulator in forms.items()}
        for form, seconds in time_alternating(runs, rounds).items():
            spread = Spread.of([value / frames / batch for value in seconds])
            figures[f"{form}, batch {batch}"] = spread
            sys.stdout.write(f"{name:<18}{count:>7} particles  {form:<12}batch {batch:>4}  {spread.format():>28} ms\n")
            sys.stdout.flush()
    return {"particles": count, "seconds_per_frame": figures}


def main() -> None:
    """Measure, print, and write JSON if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--zoo", nargs="+", help="models (default: all)")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16, 128])
    parser.add_argument("--rounds", type=int, default=5)
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    machine = describe_machine(chosen.device, chosen.threads)
    sys.stdout.write(f"{machine}; per frame of one scene\n")
    models = {name: time_model(name, chosen.batches, chosen.rounds, chosen.device) for name in chosen.zoo or Zoo.list()}
    write_json(chosen.json, {"machine": machine, "models": models})


if __name__ == "__main__":
    main()
