"""Entries of the zoo, read as text and tensors: nothing is unpickled, imported or fetched."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch
from filelock import lock_descriptor
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from nmpm._support.bounded_files import read_bounded, read_yaml
from nmpm._support.limits import WEIGHT_BYTES
from nmpm._support.messages import one_line
from nmpm.errors import DataError, NmpmError, ZooError
from nmpm.zoo.building import build, read_recipe
from nmpm.zoo.lifecycle import CARD_FORMAT
from nmpm.zoo.pretrained import Pretrained

CARD = "card.yaml"
REAL = frozenset({torch.float16, torch.bfloat16, torch.float32, torch.float64})
"""Types of stored weights that are converted to the model's own."""


def read_card(folder: Path) -> dict[str, Any]:
    """The content of an entry's card.

    Raises:
        ZooError: if it is missing or damaged, or a newer nmpm wrote it.
    """
    try:
        card = read_yaml(folder / CARD)
    except DataError as error:
        raise ZooError(str(error)) from error
    found = card.get("format", 0)  # cards of version 0.1 state none
    if not isinstance(found, int) or found > CARD_FORMAT:
        raise ZooError(
            f"{folder / CARD} has format {one_line(found, 60)}; this nmpm reads up to {CARD_FORMAT}: pip install"
            " --upgrade nmpm."
        )
    return card


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Lets one process at a time write to the entries of a zoo. What is locked are folders, without a file in them.

    Args:
        folder: Of an entry. As a variant's lies within that of its dataset, which may be replaced, the two folders that
            an entry lies in are locked: of any two entries of a zoo they have one in common.
    """
    with ExitStack() as locks:
        inner = folder.resolve().parent
        for place in (inner.parent, inner):  # in this order, so that none waits for ever
            place.mkdir(parents=True, exist_ok=True)
            try:
                handle = os.open(place, os.O_RDONLY)
            except PermissionError:  # a folder around a zoo that others own
                if place == inner:
                    raise
                continue
            locks.callback(os.close, handle)
            lock_descriptor(handle)
        yield


def load_entry(folder: Path) -> Pretrained:
    """The model of an entry's folder, on the CPU.

    Raises:
        ZooError: if a file is missing or damaged, asks for more than `nmpm._support.limits` allows, or the weights are
            not those of card and recipe.
    """
    card = read_card(folder)
    weights = _read_weights(folder / "model.safetensors", card)
    try:
        emulator = build(read_recipe(read_yaml(folder / "config.yaml")))
    except DataError as error:
        raise ZooError(str(error)) from error
    except Exception as error:  # values from anywhere may raise anything
        kind = "" if isinstance(error, NmpmError) else f" ({type(error).__name__})"
        reason = one_line(error, 600)
        raise ZooError(f"{folder / 'config.yaml'} does not describe a model{kind}: {reason}") from error
    _check_weights(folder / "model.safetensors", emulator.state_dict(), weights)
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


def _check_weights(path: Path, expected: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> None:
    """Compare names, shapes and types with the model's.

    Raises:
        ZooError: naming the first tensor that differs or is not finite.
    """
    for problem, names in (("lacks", set(expected) - set(found)), ("has the unknown", set(found) - set(expected))):
        if names:
            raise ZooError(
                f"{path} {problem} tensors {one_line(', '.join(sorted(names)), 100)} of config.yaml's model."
            )
    for name, tensor in found.items():
        own = expected[name]
        if tensor.shape != own.shape:
            raise ZooError(
                f"{path}: {name} has the shape {one_line(tuple(tensor.shape), 100)}; the model of config.yaml needs"
                f" {tuple(own.shape)}."
            )
        if tensor.dtype != own.dtype and not {tensor.dtype, own.dtype} <= REAL:
            raise ZooError(f"{path}: {name} is of {tensor.dtype}; the model of config.yaml needs {own.dtype}.")
        if not torch.isfinite(tensor).all():
            raise ZooError(f"{path}: {name} holds values that are not finite.")
