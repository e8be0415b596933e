"""One call of a zoo model as a rollout makes it: by the emulator, by ONNX Runtime and by AOTInductor, in turns.

python benchmarks/exported.py --zoo goop --particles 1000 --repeats 30 --json exported.json

With its constraints (held) and without (free), one scene, one thread each. Milliseconds of the processor, median and
range; the largest difference from the emulator's positions in one call, in cells.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import onnxruntime
import torch
from torch import Tensor, _inductor
from turns import in_one_process, processor_time, write

from nmpm.emulator.constraints import Constraints
from nmpm.emulator.model import Emulator
from nmpm.particles import Particles
from nmpm.zoo import Zoo
from nmpm.zoo.export import FORMATS, Step

Call = Callable[[], Tensor]


def eager(emulator: Emulator, state: Particles) -> Call:
    """The emulator's own call; the context is a rollout's, computed once."""
    context = emulator.context(state)
    return lambda: emulator(state, context).position


def by_onnx_runtime(path: Path, inputs: dict[str, Tensor]) -> Call:
    """ONNX Runtime on one thread that does not spin while others have their turn."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    arrays = {name: value.numpy() for name, value in inputs.items()}
    return lambda: torch.from_numpy(session.run(["positions"], arrays)[0])


def by_inductor(path: Path, inputs: dict[str, Tensor]) -> Call:
    """The package's machine code, called from Python."""
    model = _inductor.aoti_load_package(str(path))
    ordered = {name: value.contiguous() for name, value in inputs.items()}
    return lambda: model(**ordered)[0]


EXPORTED = {"onnx": ("ONNX Runtime", by_onnx_runtime), "pt2": ("AOTInductor", by_inductor)}


def calls_of(emulator: Emulator, state: Particles, folder: Path, label: str, formats: Sequence[str]) -> dict[str, Call]:
    """The ways to make one call, the exported ones from files written to a folder."""
    step = Step(emulator)
    inputs = {"position": state.position, "velocity": state.velocity, "material": state.material}
    inputs |= {"gravity": state.gravity, "solid": step.emulator.solid(state)}
    budget = emulator.budget(state)
    inputs |= {} if budget is None else {"budget": budget}
    inputs = {value.name: inputs[value.name] for value in step.inputs}
    calls = {f"{label}, eager": eager(step.emulator, state)}
    for suffix in formats:
        path, start = folder / f"{label}.{suffix}", time.perf_counter()
        FORMATS[suffix].write(step, {}, path)
        sys.stderr.write(f"{label} {suffix}: written in {time.perf_counter() - start:.0f} s\n")
        name, run = EXPORTED[suffix]
        calls[f"{label}, {name}"] = run(path, inputs)
    return calls


def main() -> None:
    """Export, measure, print, and write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zoo", default="goop")
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--forms", nargs="+", choices=["held", "free"], default=["held", "free"])
    parser.add_argument("--formats", nargs="+", choices=list(EXPORTED), default=list(EXPORTED))
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
            calls |= calls_of(emulator, state, Path(name), label, chosen.formats)
        spent = in_one_process(calls, chosen.repeats, processor_time)
        lines = report(calls, spent, min(model.emulator.grid.spacing))
    write(chosen.json, {"zoo": chosen.zoo, "particles": chosen.particles, "lines": lines})


def report(calls: dict[str, Call], spent: dict[str, list[float]], cell: float) -> list[dict[str, object]]:
    """Print a line for each way, and give the same as plain data."""
    lines: list[dict[str, object]] = []
    milliseconds = {name: [1e3 * seconds for seconds in values] for name, values in spent.items()}
    for name, values in milliseconds.items():
        own = f"{name.partition(',')[0]}, eager"
        gap = (calls[name]() - calls[own]()).abs().max().item() / cell
        ratios = [mine / other for mine, other in zip(values, milliseconds[own], strict=True)]
        middle, share = statistics.median(values), statistics.median(ratios)
        sys.stdout.write(
            f"{name:<24}{middle:7.2f} ms ({min(values):.2f}-{max(values):.2f})   {share:.2f} of eager"
            f" ({min(ratios):.2f}-{max(ratios):.2f})   {gap:.1e} cells\n"
        )
        lines.append({"name": name, "ms": values, "median_ms": middle, "of_eager": share, "cells": gap})
    return lines


if __name__ == "__main__":
    main()
