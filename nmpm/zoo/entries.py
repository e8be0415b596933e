"""Entries and checkpoints, read as text and tensors: nothing is unpickled, imported or fetched, sizes are bounded."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor, nn
from torch.nn.modules import module as hooks

from nmpm._support.bounded_files import TEXT_BYTES, read_bounded, read_yaml
from nmpm._support.messages import one_line
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.errors import ConfigError, DataError, NmpmError, ZooError
from nmpm.processors import GridLayout
from nmpm.zoo.card import BEST, CARD, CONFIG, WEIGHT_BYTES, WEIGHTS, read_card
from nmpm.zoo.pretrained import Pretrained

if TYPE_CHECKING:
    from nmpm.training.module import EmulatorModule

INTEGER = 2**24
"""Largest integer in a model's recipe; some are exponents."""
CELLS, FRAMES = 2**24, 2**12
"""Cells of a model's grid, 4096² or 256³, and frames that one call predicts."""
PARAMETERS, LAYERS = 10**9, 5_000
"""Parameters of a network; its modules, and tensors of parameters."""
REAL = frozenset({torch.float16, torch.bfloat16, torch.float32, torch.float64})
"""Types of stored weights that are converted to the model's own."""


def load_entry(folder: Path) -> Pretrained:
    """The model of an entry's folder, on the CPU.

    Raises:
        ZooError: if a file is missing or damaged, asks for more than is loaded, or the weights are
            not those of card and recipe.
    """
    card = read_card(folder)
    weights = _read_weights(folder / WEIGHTS, card)
    try:
        emulator = build(read_recipe(read_yaml(folder / CONFIG)))
    except DataError as error:
        raise ZooError(str(error)) from error
    except Exception as error:  # values from anywhere may raise anything
        kind = "" if isinstance(error, NmpmError) else f" ({type(error).__name__})"
        reason = one_line(error, 600)
        raise ZooError(f"{folder / CONFIG} does not describe a model{kind}: {reason}") from error
    _check_weights(folder / WEIGHTS, emulator.state_dict(), weights)
    emulator.load_state_dict(weights)
    return Pretrained(emulator.eval().requires_grad_(False), card)


def _read_weights(path: Path, card: Mapping[str, Any]) -> dict[str, Tensor]:
    try:
        content = read_bounded(path, WEIGHT_BYTES)
    except DataError as error:
        raise ZooError(str(error)) from error
    if hashlib.sha256(content).hexdigest() != card.get("sha256"):
        raise ZooError(f"{path} is not the file that {CARD} was written for (its SHA-256 differs): fetch it again.")
    try:
        return load(content)
    except (SafetensorError, KeyError, ValueError, RuntimeError) as error:
        raise ZooError(f"{path} is not a file of tensors: {one_line(error)}") from error


def _check_weights(path: Path, expected: Mapping[str, Tensor], stored: Mapping[str, Tensor]) -> None:
    """Raise ZooError for the first tensor whose name, shape or type is not the model's, or that is not finite."""
    for problem, names in (("lacks", set(expected) - set(stored)), ("has the unknown", set(stored) - set(expected))):
        if names:
            raise ZooError(
                f"{path} {problem} tensors {one_line(', '.join(sorted(names)), 100)} of config.yaml's model."
            )
    for name, tensor in stored.items():
        needed = expected[name]
        if tensor.shape != needed.shape:
            raise ZooError(
                f"{path}: {name} has the shape {one_line(tuple(tensor.shape), 100)}; the model of config.yaml needs"
                f" {tuple(needed.shape)}."
            )
        if tensor.dtype != needed.dtype and not {tensor.dtype, needed.dtype} <= REAL:
            raise ZooError(f"{path}: {name} is of {tensor.dtype}; the model of config.yaml needs {needed.dtype}.")
        if not torch.isfinite(tensor).all():
            raise ZooError(f"{path}: {name} holds values that are not finite.")


def load_checkpoint(path: Path) -> Pretrained:
    """The model of a checkpoint, on the CPU; nothing in the file is executed.

    Its card has the training horizon and, where the run's `report.json` is found, the dataset and how it was trained;
    test errors only with the checkpoint that they are of, `best.ckpt`.

    Raises:
        DataError: if the file cannot be read, or is not a checkpoint of an emulator.
        ConfigError: if a newer nmpm wrote it, or it names a part that is not known.
    """
    module = _load_module(path)
    report = _report(path.parent.parent / "report.json") if path.parent.name == BEST.parent.name else {}
    keys = ("dataset", "versions", *(("test",) if path.name == BEST.name else ()))
    training = report.get("training")
    card = {
        "name": str(path),
        "dataset": "not stated by the checkpoint",
        **{key: report[key] for key in keys if key in report},
        "training": (training if isinstance(training, dict) else {})
        | {"horizon": module.emulator.frames * module.unroll},
    }
    return Pretrained(module.emulator.eval().requires_grad_(False), card)


def _load_module(path: Path) -> EmulatorModule:
    """The module of a checkpoint, after its size has been checked."""
    from nmpm.training.checkpoints import read_checkpoint
    from nmpm.training.module import load_module  # imports Lightning, which entries do without

    try:
        stored = read_checkpoint(path).get("hyper_parameters")
        if not isinstance(stored, dict) or not isinstance(stored.get("unroll"), int):
            raise DataError(f"{path} is not a checkpoint of an emulator: it lacks hyperparameters, such as unroll.")
        names = [field.name for field in dataclasses.fields(EmulatorRecipe)]
        read_recipe({name: stored[name] for name in names if name in stored})
        with bounded_network():
            return load_module(path)
    except (ConfigError, DataError) as error:
        raise type(error)(one_line(error, 600)) from error
    except Exception as error:  # values from anywhere may raise anything
        reason = f"{type(error).__name__}: {one_line(error, 300)}"
        raise DataError(f"{path} is not a checkpoint of an emulator of this version ({reason}).") from error


def _report(path: Path) -> dict[str, Any]:
    """The report of a run; empty if there is none that can be read, as a model rolls out without."""
    try:
        report = json.loads(read_bounded(path, 16 * TEXT_BYTES))
    except (DataError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}


def read_recipe(plain: Mapping[str, Any]) -> EmulatorRecipe:
    """The recipe that plain data describe, if its model is of a bounded size.

    Raises:
        ConfigError: if a number is not finite or too large, or grid or network exceed the limits. Data
            that do not describe a recipe may raise any other exception.
    """
    _check_numbers(plain)
    recipe = EmulatorRecipe.from_dict(plain)
    for name, size, limit in (("cells", recipe.grid.size, CELLS), ("frames", recipe.frames, FRAMES)):
        if size > limit:
            raise ConfigError(f"{name}: {size:,} are more than {limit:,}, the most that is loaded.")
    layout = GridLayout.of(recipe.scene, recipe.frames)
    # Without memory for its parameters, which not all plugins support; the size is watched again in `build`.
    with torch.device("meta"), bounded_network(), suppress(RuntimeError, NotImplementedError):
        recipe.processor.build(layout)
    return recipe


def build(recipe: EmulatorRecipe) -> Emulator:
    """The emulator of a recipe; raises ConfigError where its network is too large."""
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


@contextmanager
def bounded_network() -> Iterator[None]:
    """Count parameters, their tensors and modules as networks are built; torch's random state stays as it was.

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
