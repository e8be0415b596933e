"""`nmpm export NAME --format onnx`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nmpm.errors import ConfigError, DataError

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator
    from nmpm.zoo.export import Part

DESCRIPTION = """Write a trained model as a file that runs without nmpm: ONNX, for ONNX Runtime, without torch; or
a package of AOTInductor (.pt2), machine code for the processor that it is made on, for torch in Python or C++. Scenes
and particles may be as many as you like. The file says itself what goes in and comes out, in which units; it is
compared with the model once it is written, and removed if it differs."""
TOLERANCE = 1e-3
"""Largest difference, in cells, that a file may have from its model over one call."""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["export", "goop", "--format", "onnx"]."""
    parser = argparse.ArgumentParser(prog="nmpm export", description=DESCRIPTION)
    parser.add_argument("model", help="a model of the zoo, or a checkpoint: runs/goop/checkpoints/best.ckpt")
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
        help="only what makes the step's solid fraction of obstacle particles, once per scene",
    )
    parser.add_argument("--free", action="store_true", help="without the model's constraints: the network's own doing")
    parser.add_argument("--out", type=Path, help="file to write (default: the model's name, in this folder)")
    parser.set_defaults(part="Step")
    chosen = parser.parse_args(words[1:])
    out = chosen.out or Path(f"{_plain_name(chosen.model, chosen.part)}.{chosen.format}")
    if out.suffix != f".{chosen.format}":
        raise ConfigError(f"--out {out}: the name of a file of --format {chosen.format} ends in .{chosen.format}.")
    if not out.parent.is_dir():
        raise ConfigError(f"--out {out}: the folder {out.parent} does not exist.")
    _export(chosen, out)


def _export(chosen: argparse.Namespace, out: Path) -> None:
    from nmpm.zoo import export

    emulator, training_data = _model(chosen.model)
    if chosen.free:
        emulator = emulator.unconstrained()
    kinds: Mapping[str, type[Part]] = {kind.__name__: kind for kind in (export.Step, export.Network, export.Solid)}
    part = kinds[chosen.part](emulator)
    form = export.FORMATS[chosen.format]
    form.write(part, export.description(part, chosen.model, training_data), out)
    difference = form.difference(part, out, batch=1, count=300)
    if not difference <= TOLERANCE:
        out.unlink()
        raise DataError(
            f"{out} was not the model: it differed by {difference:.3g} cells in one call, so it is gone. Try the other"
            " --format."
        )
    _tell(part, out, difference)


def _tell(part: Part, out: Path, difference: float) -> None:
    values = [("in", value) for value in part.inputs] + [("out", value) for value in part.outputs]
    for way, value in values:
        sys.stdout.write(f"{way:<4}{value.name:<14}({', '.join(map(str, value.shape))})  {value.about}\n")
    sys.stdout.write(f"wrote {out}; largest difference from the model in one call: {difference:.1e} cells\n")


def _plain_name(model: str, part: str) -> str:
    name = Path(model).stem if model.endswith(".ckpt") else model.replace("/", "-")
    return name if part == "Step" else f"{name}-{'processor' if part == 'Network' else 'solid'}"


def _model(name: str) -> tuple[Emulator, str]:
    """The emulator of that name or checkpoint, and what it was trained on."""
    path = Path(name)
    if path.suffix == ".ckpt" or path.is_file():
        from nmpm.training.checkpoints import load_module

        return load_module(path).emulator, f"not told by the checkpoint {path.name}"
    from nmpm.zoo.registry import Zoo

    pretrained = Zoo.load(name)
    return pretrained.emulator, _data(pretrained.card)


def _data(card: Mapping[str, Any]) -> str:
    return f"{card['dataset']}. {card.get('about', '')}".strip()
