"""Time rollouts of zoo models by the runtimes of a device, alternating, and compare them with the CPU's.

python benchmarks/gpu_rollouts.py --device cuda
python benchmarks/gpu_rollouts.py --device cuda --zoo goop wbcsph --batches 1 64 --json gpu_rollouts.json

A thrown block of as many particles as the model's test scenes have, so many times per batch. Milliseconds per frame of
one scene, median and range: operation by operation, and on a GPU as CUDA graphs, and by kernels in Triton where they
take the model. Before that one bundle without TensorFloat-32 by each runtime is compared with the CPU's: the largest
gap in cells, which may be twice the one operation by operation and 0.001. Exits with 1 if one is larger.
"""

from __future__ import annotations

import sys
from functools import partial

import torch
from timing import Spread, describe_machine, make_timing_parser, time_alternating, write_json

from nmpm.emulator import Emulator, rollout
from nmpm.emulator.runtimes import find_runtime
from nmpm.zoo import Pretrained, Zoo
from nmpm.zoo.measures.speed import repeat_scene, thrown_scene

GRAPHS = ("cuda-graph", "triton")
BUNDLES = 4
"""Calls of the network in each timed rollout."""


def make_forms(model: Pretrained, device: torch.device) -> dict[str, Emulator]:
    """The emulator by each runtime of the device that takes it."""
    fitting = [
        name for name in GRAPHS if device.type == "cuda" and not find_runtime(name).unsupported_reason(model.emulator)
    ]
    return {"eager": model.emulator, **{name: model.optimized(name).emulator for name in fitting}}


def compare_with_cpu(name: str, forms: dict[str, Emulator]) -> bool:
    """Print how far a bundle by each runtime is from the CPU's, and return whether all agree."""
    model, allowed = Zoo.load(name), torch.backends.cudnn.allow_tf32
    state, own, gaps = thrown_scene(model), model.emulator, {}
    torch.backends.cudnn.allow_tf32 = False
    for form, emulator in forms.items():
        anew = emulator.with_runtime(form)  # graphs keep what they were recorded with
        gap = rollout(anew, state.to(emulator.device), own.frames).cpu() - rollout(own, state, own.frames)
        gaps[form] = float(gap.abs().max()) / min(own.grid.spacing)
    torch.backends.cudnn.allow_tf32 = allowed
    limit = 1e-3 + 2 * gaps["eager"]
    for form, cells in gaps.items():
        said = "agrees with" if cells <= limit else "DIFFERS from"
        sys.stdout.write(f"{name:<18}{form:<12}{said} the CPU: {cells:.1e} cells apart after a bundle\n")
    return all(cells <= limit for cells in gaps.values())


def time_model(name: str, batches: list[int], rounds: int, device: torch.device) -> dict[str, object]:
    """Print and return a model's times by runtime and batch."""
    model = Zoo.load(name, device=device)
    one = thrown_scene(model)
    count = one.position.shape[1]
    forms, figures = make_forms(model, device), {}
    agrees = compare_with_cpu(name, forms)
    frames = BUNDLES * model.emulator.frames
    for batch in batches:
        state = repeat_scene(one, batch)
        runs = {form: partial(rollout, emulator, state, frames) for form, emulator in forms.items()}
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
