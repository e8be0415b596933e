"""Compare a checkpoint with the model and optimizer that are to go on from it, part by part."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from torch.optim import Optimizer

from nmpm._support.specs import class_path
from nmpm.emulator import EmulatorRecipe
from nmpm.errors import ConfigError
from nmpm.scene import Scene

COMPARED = ("cells", "frames", "transfer", "processor", "decoder")
"""Parts of a recipe that its weights were trained for; constraints and noise may change."""


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
    theirs, ours = stored.to_dict(), mine.to_dict()
    found = [line for name in COMPARED for line in _differences(theirs[name], ours[name], f"model.{name}")]
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


def _differences(theirs: Any, mine: Any, name: str) -> Iterator[str]:
    """`name = theirs, not mine` for each value that differs; classes that differ stand for their arguments."""
    if theirs == mine:
        return
    if not (isinstance(theirs, Mapping) and isinstance(mine, Mapping)):
        yield f"{name} = {theirs}, not {mine}"
    elif theirs.get("class_path") != mine.get("class_path"):
        yield f"{name} = {theirs.get('class_path')}, not {mine.get('class_path')}"
    else:
        for key in theirs:
            inner = name if key == "init_args" else f"{name}.{key}"
            yield from _differences(theirs[key], mine.get(key), inner)
