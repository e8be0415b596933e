"""Emulators from untrusted recipes: their size is checked before anything is allocated."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn
from torch.nn.modules import module as hooks

from nmpm._support.limits import CELLS, FRAMES, INTEGER, LAYERS, PARAMETERS
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.errors import ConfigError
from nmpm.processors import GridLayout


def read_recipe(plain: Mapping[str, Any]) -> EmulatorRecipe:
    """The recipe that plain data describe, if its model is of a bounded size.

    Raises:
        ConfigError: if a number is not finite or too large, or grid or network exceed `nmpm._support.limits`. Data
            that do not describe a recipe may raise any other exception.
    """
    _check_numbers(plain)
    recipe = EmulatorRecipe.from_dict(plain)
    for name, size, limit in (("cells", recipe.grid.size, CELLS), ("frames", recipe.frames, FRAMES)):
        if size > limit:
            raise ConfigError(f"{name}: {size:,} are more than {limit:,}, the most that is loaded.")
    _check_network(recipe)
    return recipe


def build(recipe: EmulatorRecipe) -> Emulator:
    """The emulator of a recipe; raises as `bounded_network` where its network is too large."""
    with bounded_network():
        return recipe.build()


def _check_numbers(value: Any, key: str = "the recipe") -> None:
    if isinstance(value, Mapping):
        for name, item in value.items():
            _check_numbers(item, str(name))
    elif isinstance(value, list):
        for item in value:
            _check_numbers(item, key)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{key}: {value} is not finite.")
    elif isinstance(value, int) and abs(value) > INTEGER:
        raise ConfigError(f"{key}: an integer is larger than {INTEGER:,}, the most that is loaded.")


def _check_network(recipe: EmulatorRecipe) -> None:
    """Build the network without memory for its parameters, to learn whether it is too large."""
    scene = recipe.scene
    inputs, outputs = len(scene.input_channels), len(scene.output_channels)
    with torch.device("meta"), bounded_network():
        try:
            recipe.processor.build(GridLayout(inputs, outputs, recipe.frames, scene.periodic))
        except (RuntimeError, NotImplementedError):
            return  # plugins need not support the meta device; the size is watched again in `build`


@contextmanager
def bounded_network() -> Iterator[None]:
    """Count parameters, their tensors and modules as networks are built for stored weights.

    The weights that they draw first leave torch's random state as it was.

    Raises:
        ConfigError: at the first that is too many.
    """
    counts = {"parameters": 0, "tensors": 0, "modules": 0}
    limits = {"parameters": PARAMETERS, "tensors": LAYERS, "modules": LAYERS}

    def add(kind: str, number: int) -> None:
        counts[kind] += number
        if counts[kind] > limits[kind]:
            raise ConfigError(f"processor: its network has more than {limits[kind]:,} {kind}, the most that is loaded.")

    def add_parameter(_module: nn.Module, _name: str, parameter: nn.Parameter | None) -> None:
        add("parameters", 0 if parameter is None else parameter.numel())
        add("tensors", 1)

    def add_module(_module: nn.Module, _name: str, _submodule: nn.Module | None) -> None:
        add("modules", 1)

    handles = [
        hooks.register_module_parameter_registration_hook(add_parameter),
        hooks.register_module_module_registration_hook(add_module),
    ]
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        for handle in handles:
            handle.remove()
