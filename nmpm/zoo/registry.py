"""The model zoo: pretrained emulators with cards that say how good they are and what they were trained on.

An entry is a folder `zoo/<name>` (or `zoo/<dataset>/<variant>`) of

    card.yaml           what it is, how it was trained, its measured errors, the weights' SHA-256
    config.yaml         the emulator's recipe: scene, grid, transfer, processor, decoder
    model.safetensors   weights and normalisation statistics
    README.md           the card for reading

Loading reads text and tensors only: nothing is unpickled, imported or fetched.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from nmpm._support.devices import find_device
from nmpm._support.shipped import shipped
from nmpm.data.initial_states import thrown_blocks
from nmpm.emulator import Emulator, EmulatorRecipe, rollout
from nmpm.errors import ConfigError, ZooError
from nmpm.particles import Particles
from nmpm.scene import Scene

NETWORK_PRECISIONS: Mapping[str, torch.dtype] = MappingProxyType({"float32": torch.float32, "bfloat16": torch.bfloat16})
"""What a pretrained network can run in, by name."""
NAME = re.compile(r"[a-z0-9][a-z0-9_-]*(/[a-z0-9][a-z0-9_-]*)?")


@dataclass(frozen=True)
class Pretrained:
    """A model from the zoo, ready to roll out or to fine-tune.

    Args:
        emulator: In evaluation mode.
        card: What `card.yaml` says.
    """

    emulator: Emulator
    card: Mapping[str, Any]

    @property
    def scene(self) -> Scene:
        """The facts of the scenes that the model was trained for."""
        return self.emulator.scene

    def example(self, seed: int = 0, count: int = 1000, blocks: int = 1) -> Particles:
        """A state to start from: blocks of particles thrown into the scene's box."""
        return thrown_blocks(self.scene, count=count, blocks=blocks, seed=seed)

    def with_network(self, precision: str) -> Pretrained:
        """The same model with the network's weights in "float32" or, faster on most processors, in "bfloat16".

        Raises:
            ConfigError: if there is no such precision, or the network cannot have it.
        """
        if precision not in NETWORK_PRECISIONS:
            raise ConfigError(f"Networks run in {' or '.join(NETWORK_PRECISIONS)}, not in {precision!r}.")
        return dataclasses.replace(self, emulator=self.emulator.with_network(NETWORK_PRECISIONS[precision]))

    def to(self, device: torch.device | str) -> Pretrained:
        """The model on another device: "cpu", "cuda", "mps", or "auto" for the best that there is.

        Raises:
            ConfigError: if the device is not there.
        """
        return dataclasses.replace(self, emulator=self.emulator.to(find_device(device)))

    def rollout(self, state: Particles, frames: int) -> Tensor:
        """Predict from a state, which is moved to the model's device.

        Returns:
            (B, frames, N, D) positions in domain length, the state's own frame not included, on the model's device.
        """
        return rollout(self.emulator, state.to(self.emulator.device), frames)


class Zoo:
    """The pretrained models that came with the package, or those of another folder."""

    @staticmethod
    def list(root: Path | None = None) -> list[str]:  # (the word users expect)
        """Names of the models."""
        root = root or shipped("zoo")
        return sorted(path.parent.relative_to(root).as_posix() for path in root.rglob("card.yaml"))

    @staticmethod
    def card(name: str, root: Path | None = None) -> dict[str, Any]:
        """What a model is, how it was trained and how well it does.

        Raises:
            ZooError: if there is no such model or its card is damaged.
        """
        return _read_yaml(_folder(name, root) / "card.yaml")

    @staticmethod
    def load(name: str, root: Path | None = None, device: torch.device | str = "cpu") -> Pretrained:
        """A pretrained model.

        Args:
            name: One of `Zoo.list()`.
            root: Folder of a zoo; the shipped one when left out.
            device: Where to compute: "cpu", "cuda", "mps", or "auto" for the best that there is.

        Raises:
            ZooError: if there is no such model, a file is missing or damaged, or the weights are not those of the card.
        """
        folder = _folder(name, root)
        card = _read_yaml(folder / "card.yaml")
        weights = _weights(folder / "model.safetensors", card)
        try:
            emulator = EmulatorRecipe.from_dict(_read_yaml(folder / "config.yaml")).build()
            emulator.load_state_dict(weights)
        except (ConfigError, RuntimeError, KeyError, TypeError) as error:
            raise ZooError(f"{folder}: config.yaml and model.safetensors do not make a model: {error}") from error
        return Pretrained(emulator.eval().requires_grad_(False), card).to(device)


def check_name(name: str) -> str:
    """The name, if it can be one.

    Raises:
        ZooError: if it cannot, such as one that would lead out of the zoo.
    """
    if not NAME.fullmatch(name):
        raise ZooError(
            f"{name!r} cannot name a model: use lower-case letters, digits, - and _, with at most one / between "
            "dataset and variant."
        )
    return name


def _folder(name: str, root: Path | None) -> Path:
    root = root or shipped("zoo")
    folder = root / check_name(name)
    if not (folder / "card.yaml").is_file():
        raise ZooError(f"The zoo holds no model {name!r}; it holds {', '.join(Zoo.list(root)) or 'none'}.")
    return folder


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ZooError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise ZooError(f"{path} should hold keys and values.")
    return content


def _weights(path: Path, card: Mapping[str, Any]) -> dict[str, Tensor]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ZooError(f"{path} cannot be read: {error}") from error
    if hashlib.sha256(content).hexdigest() != card.get("sha256"):
        raise ZooError(f"{path} is not the file that card.yaml was written for (its SHA-256 differs): fetch it again.")
    try:
        weights = load(content)
    except SafetensorError as error:
        raise ZooError(f"{path} is not a file of tensors: {error}") from error
    for name, tensor in weights.items():
        if not torch.isfinite(tensor).all():
            raise ZooError(f"{path}: {name} holds numbers that are not finite.")
    return weights
