"""Time rollouts of zoo models on a device, alternating, and compare them with the CPU's.

python benchmarks/gpu_rollouts.py --device cuda
python benchmarks/gpu_rollouts.py --device cuda --zoo goop wbcsph --batches 1 64 --json gpu_rollouts.json

A thrown block of as many particles as the model's test scenes have, so many times per batch. Milliseconds per frame of
one scene, median and range: operation by operation, by CUDA graphs of torch's operations (the default), and by each
engine of another package that takes the model, such as plugins/nmpm-triton. Before that one bundle without
TensorFloat-32 is compared with the CPU's: the largest gap in cells, which may be twice the one operation by operation
and 0.001. Exits with 1 if one is larger.
"""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial

import torch
from timing import Spread, describe_machine, make_timing_parser, time_alternating, write_json
from torch import Tensor

from nmpm.backends import ENGINES
from nmpm.emulator import Emulator, rollout
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.transfer import without_kernels
from nmpm.zoo import Pretrained, Zoo
from nmpm.zoo.measures.speed import repeat_scene, thrown_scene

ONE_BY_ONE = "operations"
BUNDLES = 4
"""Calls of the network in each timed rollout."""


def make_forms(model: Pretrained, device: torch.device) -> dict[str, Emulator]:
    """The emulator as it is computed on the device, by name."""
    forms = {ONE_BY_ONE: model.emulator}
    if device.type == "cuda":
        forms["graphs"] = model.emulator
        for name in ENGINES.plugins:
            try:
                forms[name] = model.emulator.with_engine(name)
            except ConfigError as error:  # it does not take the model
                sys.stdout.write(f"{error}\n")
    return forms


def roll_out(form: str, emulator: Emulator, state: Particles, frames: int) -> Tensor:
    """A rollout by a form of `make_forms`; the first one computes without recordings."""
    with without_kernels() if form == ONE_BY_ONE else nullcontext():
        return rollout(emulator, state, frames)


def compare_with_cpu(name: str, forms: dict[str, Emulator]) -> bool:
    """Print how far a bundle by each form is from the CPU's, and return whether all agree."""
    model, allowed = Zoo.load(name), torch.backends.cudnn.allow_tf32
    state, own, gaps = thrown_scene(model), model.emulator, {}
    torch.backends.cudnn.allow_tf32 = False
    for form, emulator in forms.items():
        there = state.to(emulator.device)
        again = [roll_out(form, emulator, there, own.frames) for _ in range(3)][-1]  # the third call is a replay
        gap = again.cpu() - rollout(own, state, own.frames)
        gaps[form] = float(gap.abs().max()) / min(own.grid.spacing)
    torch.backends.cudnn.allow_tf32 = allowed
    limit = 1e-3 + 2 * gaps[ONE_BY_ONE]
    for form, cells in gaps.items():
        said = "agrees with" if cells <= limit else "DIFFERS from"
        sys.stdout.write(f"{name:<18}{form:<12}{said} the CPU: {cells:.1e} cells apart after a bundle\n")
    return all(cells <= limit for cells in gaps.values())


def time_model(name: str, batches: list[int], rounds: int, device: torch.device) -> dict[str, object]:
    """Print and return a model's times by form and batch."""
    model = Zoo.load(name, device=device)
    one = thrown_scene(model)
    count = one.position.shape[1]
    forms, figures = make_forms(model, device), {}
    agrees = compare_with_cpu(name, forms)
    frames = BUNDLES * model.emulator.frames
    for batch in batches:
        state = repeat_scene(one, batch)
        runs = {form: partial(roll_out, form, emulator, state, frames) for form, emulator in forms.items()}
        for form, seconds in time_alternating(runs, rounds).items():
            spread = Spread.of([value / frames / batch for value in seconds])
            figures[f"{form}, batch {batch}"] = spread
            sys.stdout.write(f"{name:<18}{count:>7} particles  {form:<12}batch {batch:>4}  {spread.format():>28} ms\n")
            sys.stdout.flush()
    return {"particles": count, "seconds_per_frame": figures, "agrees": agrees}


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
    sys.exit(not all(model["agrees"] for model in models.values()))


if __name__ == "__main__":
    main()
