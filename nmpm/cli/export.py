"""`nmpm export MODEL --format onnx`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nmpm.cli.command import UsageError
from nmpm.cli.options import DeviceOptions, ModelOptions, check_output
from nmpm.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Export(ModelOptions, DeviceOptions):
    """Write a model as a file that runs without nmpm: ONNX, or AOTInductor's.

    ONNX is for ONNX Runtime, without torch; a package of AOTInductor (.pt2) is machine code for the device that
    --device names, for torch in Python or C++. The numbers of scenes and particles stay open. The file's metadata
    describe its inputs and outputs with their units. After writing, its outputs are compared with the model's; if they
    differ, the file is deleted.

    Args:
        format: Of the file (default: onnx).
        processor: Only the network, from a grid state to grid velocities (default: the whole step, particles to
            particles).
        solid: Only the solid fraction of obstacle particles, an input of the step, computed once per scene.
        free: Without the model's constraints: the network alone.
        out: File to write (default: the model's name, in this folder).

    Examples:
        nmpm export goop                              goop.onnx: one step, particles to particles
        nmpm export goop --processor --out net.onnx   only the network
        nmpm export waterramps --solid                what it sees of obstacles, once per scene
        nmpm export runs/goop --format pt2 --device cuda
    """

    format: Literal["onnx", "pt2"] = "onnx"
    processor: bool = False
    solid: bool = False
    free: bool = False
    out: Path | None = None

    def __post_init__(self) -> None:
        if self.processor and self.solid:
            raise UsageError("--solid is not allowed with --processor. See nmpm export --help.")
        out = self._file
        if out.suffix != f".{self.format}":
            raise ConfigError(f"--out {out}: for --format {self.format} its name must end in .{self.format}.")
        check_output("--out", out)
        super().__post_init__()
        if self.format == "onnx" and self.device != "cpu":
            raise ConfigError(
                f"--device {self.device}: ONNX files run on any device, which ONNX Runtime's providers decide; leave"
                " the option out, or take --format pt2, whose machine code is for one device."
            )

    @property
    def _file(self) -> Path:
        if self.out is not None:
            return self.out
        path = Path(self.model)
        name = path.resolve().name if path.is_dir() else self.model.replace("/", "-")
        name = path.stem if path.suffix == ".ckpt" else name
        return Path(f"{name}{'-processor' * self.processor}{'-solid' * self.solid}.{self.format}")

    def run(self) -> None:
        from nmpm._support.machine import find_device
        from nmpm.zoo import export, load_model

        out, model = self._file, load_model(self.model, root=self.root)
        emulator = model.emulator.unconstrained() if self.free else model.emulator
        kind = export.Network if self.processor else export.Solid if self.solid else export.Step
        part: export.ExportedPart = kind(emulator).to(find_device(self.device))
        form = export.FORMATS[self.format]
        training_data = f"{model.card.get('dataset', 'not stated')}. {model.card.get('about', '')}".strip()
        difference = form.write_verified(part, export.description(part, self.model, training_data), out)
        for direction, values in (("in", part.inputs), ("out", part.outputs)):
            for value in values:
                shape = ", ".join(map(str, value.shape))
                sys.stdout.write(f"{direction:<4}{value.name:<14}({shape})  {value.description}\n")
        sys.stdout.write(f"wrote {out}; largest difference from the model in one call: {difference:.1e} cells\n")
