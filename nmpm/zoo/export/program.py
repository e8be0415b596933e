"""A part of an emulator as a program of `torch.export`, whose sizes B, N and M are left open."""

from __future__ import annotations

import torch
from torch.export import Dim, ExportedProgram

from nmpm.errors import ConfigError
from nmpm.transfer.execution import without_kernels
from nmpm.zoo.export.parts import VARYING, Part, Value


def program(part: Part) -> ExportedProgram:
    """The program of a part.

    Raises:
        ConfigError: if torch.export cannot follow the network, naming it.
    """
    sizes = {name: Dim(name, min=1) for name in VARYING}
    shapes = {value.name: _open(value, sizes) for value in part.inputs}
    example = part.draw_inputs(VARYING["B"], VARYING["N"])
    try:
        with torch.no_grad(), without_kernels():
            return torch.export.export(part, (), example, dynamic_shapes=shapes)
    except Exception as error:  # any operation of a network that a program cannot do
        recipe = type(part.emulator.recipe.processor).__name__
        raise ConfigError(
            f"torch.export cannot follow {recipe} ({type(error).__name__}: {first_line(error)}). Networks that decide"
            " by their data, or fix the number of scenes, cannot be exported: use torch.where, x.shape[0] for len(x)."
        ) from error


def first_line(error: BaseException) -> str:
    """The first line of an error's message."""
    return next((line for line in str(error).splitlines() if line.strip()), "no reason given")


def _open(value: Value, sizes: dict[str, Dim]) -> dict[int, Dim]:
    """The open axes of a value."""
    return {axis: sizes[size] for axis, size in enumerate(value.shape) if isinstance(size, str)}
