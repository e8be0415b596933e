"""Time rollouts of zoo models on a device, alternating, and compare them with the CPU's.

python benchmarks/gpu_rollouts.py --device cuda
python benchmarks/gpu_rollouts.py --device cuda --zoo goop wbcsph --batches 1 64 --json gpu_rollouts.json

A thrown block of as many particles as the model's test scenes have, so many times per batch. Milliseconds per frame of
one scene, median and range: operation by operation, by CUDA graphs of torch's operations, and by default, which are
graphs of kernels in Triton where they take the model; "tiles" are those in many programs for each scene, of which small
scenes take one by default. Before that one bundle without TensorFloat-32 is compared with
the CPU's: the largest gap in cells, which may be twice the one operation by operation and 0.001. Exits with 1 if one is
larger.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from types import MappingProxyType
from unittest import mock

import torch
from timing import Spread, describe_machine, make_timing_parser, time_alternating, write_json
from torch import Tensor

from nmpm.emulator import Emulator, rollout
from nmpm.particles import Particles
from nmpm.transfer import without_kernels
from nmpm.zoo import Pretrained, Zoo
from nmpm.zoo.measures.speed import repeat_scene, thrown_scene

ONE_BY_ONE, TILES = "operations", "tiles"
BUNDLES = 4
"""Calls of the network in each timed rollout."""


def make_forms(model: Pretrained, device: torch.device) -> dict[str, Emulator]:
    """The emulator as it is computed on the device, by name."""
    if device.type != "cuda":
        return {ONE_BY_ONE: model.emulator}
    by_torch = copy.copy(model.emulator)
    by_torch.engines = ()
    forms = {ONE_BY_ONE: model.emulator, "graphs": by_torch, "default": model.emulator}
    return forms | ({TILES: copy.copy(model.emulator)} if "triton" in model.emulator.engines else {})


def roll_out(form: str, emulator: Emulator, state: Particles, frames: int) -> Tensor:
    """A rollout by a form of `make_forms`."""
    with _FORMS.get(form, nullcontext)():
        return rollout(emulator, state, frames)


def in_tiles() -> AbstractContextManager[object]:
    """A context in which kernels in Triton take no scene in one program."""
    from nmpm.emulator.engines.triton import launch  # Triton comes with torch's builds for CUDA

    return mock.patch.object(launch, "ONE_PROGRAM", 0)


_FORMS: Mapping[str, Callable[[], AbstractContextManager[object]]] = MappingProxyType(
    {ONE_BY_ONE: without_kernels, TILES: in_tiles}
)
"""Contexts of forms; the first one also computes without recordings."""


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
