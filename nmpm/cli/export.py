"""`nmpm export MODEL --format onnx`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.options import (
    CommandParser,
    add_device_option,
    add_model_options,
    check_device,
    check_model,
    check_output,
)
from nmpm.errors import ConfigError, DataError

if TYPE_CHECKING:
    from nmpm.zoo.export import Part

DESCRIPTION = """Write a trained model as a file that runs without nmpm: ONNX, for ONNX Runtime, without torch; or
a package of AOTInductor (.pt2), machine code for the device that --device names, for torch in Python or C++. The
numbers of scenes and particles stay open. The file's metadata describe its inputs and outputs with their units. After
writing, its outputs are compared with the model's; if they differ, the file is deleted."""

_EXAMPLES = """\
examples:
  nmpm export goop                              goop.onnx: one step, particles to particles
  nmpm export goop --processor --out net.onnx   only the network
  nmpm export waterramps --solid                what it sees of obstacles, once per scene
  nmpm export runs/goop --format pt2 --device cuda
"""

TOLERANCE = 1e-3
"""Largest difference, in cells, that a file may have from its model over one call."""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["export", "goop", "--format", "onnx"]."""
    options = _parser().parse_args(words[1:])
    out = options.out or Path(f"{_file_stem(options.model, options.part)}.{options.format}")
    if out.suffix != f".{options.format}":
        raise ConfigError(f"--out {out}: for --format {options.format} its name must end in .{options.format}.")
    check_output("--out", out)
    check_model(options.model, options.root)
    check_device(options.device)
    if options.format == "onnx" and options.device != "cpu":
        raise ConfigError(
            f"--device {options.device}: ONNX files run on any device, which ONNX Runtime's providers decide; leave the"
            " option out, or take --format pt2, whose machine code is for one device."
        )
    _export(options, out)


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="nmpm export", description=DESCRIPTION, epilog=_EXAMPLES)
    add_model_options(parser)
    add_device_option(parser)
    parser.add_argument("--format", choices=["onnx", "pt2"], default="onnx", help="of the file (default: onnx)")
    parts = parser.add_mutually_exclusive_group()
    parts.add_argument(
        "--processor",
        dest="part",
        action="store_const",
        const="Network",
        help="only the network, from a grid state to grid velocities (default: the whole step, particles to particles)",
    )
    parts.add_argument(
        "--solid",
        dest="part",
        action="store_const",
        const="Solid",
        help="only the solid fraction of obstacle particles, an input of the step, computed once per scene",
    )
    parser.add_argument("--free", action="store_true", help="without the model's constraints: the network alone")
    parser.add_argument("--out", type=Path, help="file to write (default: the model's name, in this folder)")
    parser.set_defaults(part="Step")
    return parser


def _export(options: argparse.Namespace, out: Path) -> None:
    from nmpm._support.devices import find_device
    from nmpm._support.progress import progress_bar
    from nmpm.zoo import export, load_model

    model = load_model(options.model, root=options.root)
    emulator = model.emulator.unconstrained() if options.free else model.emulator
    kinds: Mapping[str, type[Part]] = {kind.__name__: kind for kind in (export.Step, export.Network, export.Solid)}
    part = kinds[options.part](emulator).to(find_device(options.device))
    form = export.FORMATS[options.format]
    with progress_bar(f"Writing {out.name}", 2) as step:
        training_data = f"{model.card.get('dataset', 'not stated')}. {model.card.get('about', '')}".strip()
        form.write(part, export.description(part, options.model, training_data), out)
        step(f"Comparing {out.name} with the model")
        difference = form.difference(part, out, batch=1, count=300)
    if not difference <= TOLERANCE:
        out.unlink()
        raise DataError(
            f"Verification failed: {out} differed from the model by {difference:.3g} cells in one call, more than"
            f" {TOLERANCE:g}; the file was deleted. Try the other --format."
        )
    _print(part, out, difference)


def _print(part: Part, out: Path, difference: float) -> None:
    values = [("in", value) for value in part.inputs] + [("out", value) for value in part.outputs]
    for direction, value in values:
        shape = ", ".join(map(str, value.shape))
        sys.stdout.write(f"{direction:<4}{value.name:<14}({shape})  {value.description}\n")
    sys.stdout.write(f"wrote {out}; largest difference from the model in one call: {difference:.1e} cells\n")


def _file_stem(model: str, part: str) -> str:
    path = Path(model)
    name = path.stem if path.suffix == ".ckpt" else path.resolve().name if path.is_dir() else model.replace("/", "-")
    return name if part == "Step" else f"{name}-{'processor' if part == 'Network' else 'solid'}"
