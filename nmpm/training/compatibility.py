"""Compare a checkpoint with the model and optimizer that are to go on from it, part by part."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from torch.optim import Optimizer

from nmpm._support.plain_data import class_path, to_plain
from nmpm.emulator import EmulatorRecipe
from nmpm.errors import ConfigError
from nmpm.scene import Scene

COMPARED = ("cells", "frames", "transfer", "processor", "decoder")
"""Parts of a recipe that its weights were trained for; constraints and noise may change."""

UNREPORTED = ("scene", "format", "recompute", "compile")
"""Hyperparameters that `changed_arguments` leaves out: compared elsewhere, or without influence on the result."""

NEW = "not an option yet"
"""What an argument was that the version which wrote a checkpoint did not have."""


def check_horizon(frames: int, unroll: int, horizon: int) -> None:
    """Make sure that training windows hold every frame that a training step predicts; longer ones are cut.

    Raises:
        ConfigError: naming both numbers of frames.
    """
    if horizon < frames * unroll:
        raise ConfigError(
            f"data.horizon = {horizon} is shorter than the {frames * unroll} frames that a training step predicts"
            f" (model.frames = {frames} times model.unroll = {unroll}): give TrajectoryDataModule"
            f" horizon={frames * unroll}, or unroll less."
        )


def check_same_scene(mine: Scene, theirs: Scene, data: str = "the data's") -> None:
    """Make sure that a model's scene is that of its data.

    Args:
        mine: The model's.
        theirs: The data's.
        data: Whose scene `theirs` is, in words.

    Raises:
        ConfigError: naming the facts in which they differ.
    """
    different = mine.differences(theirs)
    if different:
        facts = "; ".join(f"{name} = {getattr(mine, name)}, not {getattr(theirs, name)}" for name in different)
        raise ConfigError(
            f"The model was made for other scenes than {data}: {facts}. For another box, or other particles, take"
            " EmulatorModule.of(emulator.over(data.scene)); what else differs needs a model of its own."
        )


def check_same_recipe(hyper_parameters: Mapping[str, Any], mine: EmulatorRecipe) -> None:
    """Make sure that a checkpoint's weights suit a recipe.

    Args:
        hyper_parameters: Of the checkpoint; those of version 0.1.0 are understood.
        mine: The recipe of the model that is to load it.

    Raises:
        ConfigError: naming the parts that differ with both values, or if the stored recipe cannot be read.
    """
    names = {field.name for field in dataclasses.fields(EmulatorRecipe)}
    stored = EmulatorRecipe.from_dict({name: value for name, value in hyper_parameters.items() if name in names})
    check_same_scene(stored.scene, mine.scene)
    if stored.scene.output_channels != mine.scene.output_channels or stored.scene.fields != mine.scene.fields:
        raise ConfigError(
            f"The checkpoint was trained with the fields {_listed(stored.scene.fields)}, the model has"
            f" {_listed(mine.scene.fields)}. Declare the same (data.fields); nmpm test, predict and rollout run it on"
            " scenes with more or fewer."
        )
    theirs, ours = stored.to_dict(), mine.to_dict()
    found = [
        f"{name} = {old}, not {new}"
        for part in COMPARED
        for name, old, new in _differences(theirs[part], ours[part], f"model.{part}")
    ]
    if found:
        raise ConfigError(
            f"The checkpoint has {'; '.join(found)}. Give the checkpoint's values, or train the new form in another"
            " folder (--trainer.default_root_dir)."
        )


def check_same_optimizer(checkpoint: Mapping[str, Any], optimizer: Optimizer) -> None:
    """Make sure that a checkpoint's optimizer state suits an optimizer.

    Raises:
        ConfigError: if it is the state of another kind of optimizer.
    """
    mine = class_path(type(optimizer))
    theirs = checkpoint.get("nmpm_optimizer")
    if theirs is None and checkpoint.get("optimizer_states"):  # of before 0.2, which only has the arguments' names
        group = checkpoint["optimizer_states"][0]["param_groups"][0]
        options = set(group) - {"params", "initial_lr"}
        same = options == set(optimizer.param_groups[0]) - {"params", "initial_lr"}
        theirs = mine if same else f"another optimizer, with {', '.join(sorted(options))}"
    if theirs not in (None, mine):
        raise ConfigError(
            f"The checkpoint has model.optimizer = {theirs}, not {mine}. Give the checkpoint's optimizer to go on; to"
            " train its weights by another, use EmulatorModule.of."
        )


def changed_arguments(stored: Mapping[str, Any], mine: Mapping[str, Any]) -> list[str]:
    """What a training goes on with that its checkpoint was made without, such as "model.unroll = 4 (was 2)".

    Of arguments that the version which wrote the checkpoint did not have, it says "was not an option yet".

    Args:
        stored: Hyperparameters of the checkpoint.
        mine: Those of the model that goes on from it; `check_same_recipe` has compared the parts.
    """
    names = [name for name in mine if name not in (*COMPARED, *UNREPORTED)]
    return [
        f"{name} = {new} (was {old})"
        for argument in names
        for name, old, new in _differences(stored.get(argument, NEW), mine[argument], f"model.{argument}")
    ]


def adopt_optimizer_arguments(checkpoint: Mapping[str, Any], optimizer: Optimizer) -> list[str]:
    """Replace the optimizer's arguments in a checkpoint by those of an optimizer, and keep its state.

    Without it, the arguments of a resumed training would silently be the checkpoint's, whatever the user gives. The
    learning rate keeps its place in the schedule.

    Args:
        checkpoint: Changed in place.
        optimizer: Of the same kind as the checkpoint's.

    Returns:
        What has changed, such as "model.optimizer.lr = 0.001 (was 0.003)".
    """
    states, schedules = checkpoint.get("optimizer_states") or [], checkpoint.get("lr_schedulers") or []
    if not states:
        return []
    changed: dict[str, None] = {}
    for stored, mine in zip(states[0]["param_groups"], optimizer.param_groups, strict=False):
        for name in sorted(optimizer.defaults.keys() & stored.keys() & mine.keys()):
            kept, new = "initial_lr" if name == "lr" and "initial_lr" in stored else name, mine[name]
            if to_plain(stored[kept]) == to_plain(new):
                continue
            changed[f"model.optimizer.{name} = {new} (was {stored[kept]})"] = None
            if kept == "initial_lr":
                stored["lr"] *= new / stored[kept]
            stored[kept] = new
    rates = [group["initial_lr"] for group in states[0]["param_groups"] if "initial_lr" in group]
    for schedule in schedules:
        if rates and len(schedule.get("base_lrs", ())) == len(rates):
            schedule["base_lrs"] = rates
    return list(changed)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def _differences(theirs: Any, mine: Any, name: str) -> Iterator[tuple[str, Any, Any]]:
    """(name, theirs, mine) for each value that differs; classes that differ stand for their arguments."""
    if theirs == mine:
        return
    if not (isinstance(theirs, Mapping) and isinstance(mine, Mapping)):
        yield name, theirs, mine
    elif theirs.get("class_path") != mine.get("class_path"):
        yield name, theirs.get("class_path"), mine.get("class_path")
    else:
        for key in {**theirs, **mine}:
            inner = name if key == "init_args" else f"{name}.{key}"
            yield from _differences(theirs.get(key), mine.get(key), inner)
