"""Time one call of a zoo model by the emulator, by ONNX Runtime and by AOTInductor, alternating.

python benchmarks/exported.py --zoo goop --particles 1000 --repeats 30 --json exported.json

With the model's constraints (held) and without (free), one scene, one CPU thread. Milliseconds of CPU time, median and
range; the largest difference from the emulator's positions in one call, in cells.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import onnxruntime
import torch
from timing import make_parser, time_alternating, write_json
from torch import Tensor, _inductor

from nmpm.emulator.constraints import Constraints
from nmpm.emulator.model import Emulator
from nmpm.particles import Particles
from nmpm.zoo import Zoo
from nmpm.zoo.export import FORMATS, Step

Call = Callable[[], Tensor]


def eager_call(emulator: Emulator, state: Particles) -> Call:
    """The emulator's own call, its context computed once as in a rollout."""
    context = emulator.context(state)
    return lambda: emulator(state, context).position


def onnx_call(path: Path, inputs: dict[str, Tensor]) -> Call:
    """ONNX Runtime on one thread that does not spin while the others run."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    arrays = {name: value.numpy() for name, value in inputs.items()}
    return lambda: torch.from_numpy(session.run(["positions"], arrays)[0])


def inductor_call(path: Path, inputs: dict[str, Tensor]) -> Call:
    """AOTInductor's machine code, called from Python."""
    model = _inductor.aoti_load_package(str(path))
    ordered = {name: value.contiguous() for name, value in inputs.items()}
    return lambda: model(**ordered)[0]


RUNTIMES = {"onnx": ("ONNX Runtime", onnx_call), "pt2": ("AOTInductor", inductor_call)}


def make_calls(
    emulator: Emulator, state: Particles, folder: Path, label: str, formats: Sequence[str]
) -> dict[str, Call]:
    """The emulator's call, and one per exported file; the files are written to a folder."""
    step = Step(emulator)
    inputs = {"position": state.position, "velocity": state.velocity, "material": state.material}
    inputs |= {"gravity": state.gravity, "solid": step.emulator.solid(state)}
    budget = emulator.budget(state)
    inputs |= {} if budget is None else {"budget": budget}
    inputs = {value.name: inputs[value.name] for value in step.inputs}
    calls = {f"{label}, eager": eager_call(step.emulator, state)}
    for suffix in formats:
        path, start = folder / f"{label}.{suffix}", time.perf_counter()
        FORMATS[suffix].write(step, {}, path)
        sys.stderr.write(f"{label} {suffix}: written in {time.perf_counter() - start:.0f} s\n")
        name, run = RUNTIMES[suffix]
        calls[f"{label}, {name}"] = run(path, inputs)
    return calls


def main() -> None:
    """Export, measure, print, and write JSON if asked to."""
    parser = make_parser(__doc__)
    parser.add_argument("--zoo", default="goop")
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--forms", nargs="+", choices=["held", "free"], default=["held", "free"])
    parser.add_argument("--formats", nargs="+", choices=list(RUNTIMES), default=list(RUNTIMES))
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    model = Zoo.load(chosen.zoo)
    state = model.example(count=chosen.particles)
    with tempfile.TemporaryDirectory() as name, torch.no_grad():
        calls: dict[str, Call] = {}
        constraints = {"held": model.emulator.constraints, "free": Constraints(solids=False)}
        for label in chosen.forms:
            emulator = model.emulator.with_constraints(constraints[label])
            calls |= make_calls(emulator, state, Path(name), label, chosen.formats)
        seconds = time_alternating(calls, chosen.repeats, time.process_time)
        lines = report(calls, seconds, min(model.emulator.grid.spacing))
    write_json(chosen.json, {"zoo": chosen.zoo, "particles": chosen.particles, "lines": lines})


def report(calls: dict[str, Call], seconds: dict[str, list[float]], cell: float) -> list[dict[str, object]]:
    """Print a line for each call, and return its figures."""
    lines: list[dict[str, object]] = []
    milliseconds = {name: [1e3 * value for value in values] for name, values in seconds.items()}
    for name, values in milliseconds.items():
        eager = f"{name.partition(',')[0]}, eager"
        gap = (calls[name]() - calls[eager]()).abs().max().item() / cell
        ratios = [value / other for value, other in zip(values, milliseconds[eager], strict=True)]
        middle, share = statistics.median(values), statistics.median(ratios)
        sys.stdout.write(
            f"{name:<24}{middle:7.2f} ms ({min(values):.2f}-{max(values):.2f})   {share:.2f} of eager"
            f" ({min(ratios):.2f}-{max(ratios):.2f})   {gap:.1e} cells\n"
        )
        lines.append({"name": name, "ms": values, "median_ms": middle, "of_eager": share, "cells": gap})
    return lines


if __name__ == "__main__":
    main()
