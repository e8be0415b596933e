"""Checkpoints: read as tensors and plain data, written atomically, compared with the model that goes on from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from torch import Tensor
from torch.optim import Optimizer

from nmpm._support.atomic import atomic_write
from nmpm._support.former import with_loss
from nmpm._support.messages import one_line
from nmpm._support.plain_data import class_path, to_plain
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.digests import weights_digest
from nmpm.emulator.recipe import FORMAT
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

COMPARED = ("cells", "frames", "transfer", "processor", "decoder")
"""Parts of a recipe that its weights were trained for; constraints and noise may change."""
UNREPORTED = ("scene", "recompute", "compile", "record")
"""Hyperparameters that are compared elsewhere, or without influence on the result."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint beside its place, then renames it.

    Lightning writes into the system's temporary folder, from where, on another file system, a kill leaves half a file.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:  # noqa: ARG002
        if "://" in str(path):
            super().save_checkpoint(checkpoint, path)
            return
        with atomic_write(Path(path)) as part:
            try:
                torch.save(checkpoint, part)
            except RuntimeError as error:  # (torch's writer says so of a full disk or quota)
                raise DataError(
                    f"{path} cannot be written: the disk, or your quota, is full. An earlier checkpoint stays as it"
                    " was: free some space, and go on with nmpm fit --resume RUN."
                ) from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint onto the CPU, without executing anything in it.

    Raises:
        DataError: if it is missing, damaged, or holds more than tensors and plain data.
    """
    if not path.is_file():
        raise DataError(f"{path}: there is no such checkpoint.")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch's readers raise many types on damaged files
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise DataError(
            f"{path} cannot be read as a checkpoint: it is damaged, or holds more than tensors and plain data, which"
            f" is never executed. Use another, such as best.ckpt or last.ckpt beside it. ({reason})"
        ) from error
    if not isinstance(content, dict) or not isinstance(weights := content.get("state_dict"), dict):
        raise DataError(f"{path} is not a checkpoint of a training: it has no state_dict.")
    tensors = all(isinstance(values, Tensor) for values in weights.values())
    if "nmpm_digest" in content and not (tensors and weights_digest(weights) == content["nmpm_digest"]):
        raise DataError(
            f"{path} is damaged: its weights are not those that were saved. Use another checkpoint, such as best.ckpt"
            " or last.ckpt beside it."
        )
    return content


def check_same_scene(model: Scene, data: Scene) -> None:
    """Raise ConfigError, naming the facts in which they differ, if a model's scene is not that of its data."""
    different = model.differences(data)
    if different:
        facts = "; ".join(f"{name} = {getattr(model, name)}, not {getattr(data, name)}" for name in different)
        raise ConfigError(
            f"The model was made for other scenes than the data's: {facts}. Let it take the data: fitted ="
            " model.fit_to(data); data.reading = fitted.match.reading; EmulatorModule.of(fitted.emulator)."
        )


def check_same_recipe(hyper_parameters: Mapping[str, Any], recipe: EmulatorRecipe) -> None:
    """Raise ConfigError, naming the parts that differ, if a checkpoint's weights do not suit a model's recipe."""
    names = {field.name for field in dataclasses.fields(EmulatorRecipe)}
    recipe_values = {name: value for name, value in hyper_parameters.items() if name in names}
    stored = EmulatorRecipe.from_dict({"format": FORMAT, **recipe_values})
    check_same_scene(stored.scene, recipe.scene)
    if stored.scene.output_channels != recipe.scene.output_channels or stored.scene.fields != recipe.scene.fields:
        raise ConfigError(
            f"The checkpoint was trained with the fields {_listed(stored.scene.fields)}, the model has"
            f" {_listed(recipe.scene.fields)}. Declare the same (data.fields); nmpm test, predict and rollout run it on"
            " scenes with more or fewer."
        )
    old, new = stored.to_dict(), recipe.to_dict()
    differences = [
        f"{name} = {before}, not {after}"
        for part in COMPARED
        for name, before, after in _differences(old[part], new[part], f"model.{part}")
    ]
    if differences:
        raise ConfigError(
            f"The checkpoint has {'; '.join(differences)}. Give the checkpoint's values, or train the new form in"
            " another folder (--trainer.default_root_dir)."
        )


def adopt_arguments(checkpoint: Mapping[str, Any], current: Mapping[str, Any], optimizer: Optimizer) -> list[str]:
    """Change a checkpoint, in place, to go on with the current hyperparameters and the optimizer's arguments.

    Returns what has changed, such as "model.optimizer.lr = 0.001 (was 0.003)"; ConfigError for another kind of
    optimizer.
    """
    kind, stored = class_path(type(optimizer)), with_loss(checkpoint["hyper_parameters"])
    stored_kind = checkpoint.get("nmpm_optimizer", kind)
    if stored_kind != kind:
        raise ConfigError(
            f"The checkpoint has model.optimizer = {stored_kind}, not {kind}. Give the checkpoint's optimizer to go on;"
            " to train its weights by another, use EmulatorModule.of."
        )
    changed = [
        f"{name} = {new} (was {old})"
        for argument in current.keys() - {*COMPARED, *UNREPORTED}
        for name, old, new in _differences(stored.get(argument), current[argument], f"model.{argument}")
    ]
    return sorted(changed) + _adopt_optimizer_arguments(checkpoint, optimizer)


def _adopt_optimizer_arguments(checkpoint: Mapping[str, Any], optimizer: Optimizer) -> list[str]:
    """Replace the optimizer's arguments in a checkpoint; the learning rate keeps its place in the schedule."""
    states, schedules = checkpoint.get("optimizer_states") or [], checkpoint.get("lr_schedulers") or []
    if not states:
        return []
    changed: dict[str, None] = {}
    for stored, current in zip(states[0]["param_groups"], optimizer.param_groups, strict=False):
        for name in sorted(optimizer.defaults.keys() & stored.keys() & current.keys()):
            key, new = "initial_lr" if name == "lr" and "initial_lr" in stored else name, current[name]
            if to_plain(stored[key]) == to_plain(new):
                continue
            changed[f"model.optimizer.{name} = {new} (was {stored[key]})"] = None
            if key == "initial_lr":
                stored["lr"] *= new / stored[key]
            stored[key] = new
    rates = [group["initial_lr"] for group in states[0]["param_groups"] if "initial_lr" in group]
    for schedule in schedules:
        if rates and len(schedule.get("base_lrs", ())) == len(rates):
            schedule["base_lrs"] = rates
    return list(changed)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def _differences(old: Any, new: Any, name: str) -> Iterator[tuple[str, Any, Any]]:
    """(name, old, new) for each value that differs; classes that differ stand for their arguments."""
    if old == new:
        return
    if not (isinstance(old, Mapping) and isinstance(new, Mapping)):
        yield name, old, new
    elif old.get("class_path") != new.get("class_path"):
        yield name, old.get("class_path"), new.get("class_path")
    else:
        for key in {**old, **new}:
            inner = name if key == "init_args" else f"{name}.{key}"
            yield from _differences(old.get(key), new.get(key), inner)
