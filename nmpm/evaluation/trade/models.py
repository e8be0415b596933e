"""Emulators as choices: a trained model in a precision, with or without constraints, on finer or coarser grids."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import torch

from nmpm._support.digests import short_digest, weights_digest
from nmpm._support.messages import counted
from nmpm.emulator import NETWORK_PRECISIONS, Emulator, rollout
from nmpm.errors import ConfigError
from nmpm.evaluation.trade.choices import Choice, Kind, Rollout
from nmpm.evaluation.trade.scenes import Scenes

OTHER_SCENES = " (of other scenes)"
"""Ends the name of a model that was trained on other scenes, in the settings."""


@dataclass(frozen=True)
class ModelSettings:
    """Settings of every model; all combinations of them are measured.

    Args:
        precision: Precisions of the network.
        constraints: "held", with the model's constraints, and "free", without them.
        runtime: What computes the network, see `nmpm.emulator.runtimes.RUNTIMES`.
        batch: Batch sizes, in scenes.
        threads: Numbers of torch's threads.
    """

    precision: tuple[Literal["float32", "bfloat16"], ...] = ("float32", "bfloat16")
    constraints: tuple[Literal["held", "free"], ...] = ("held", "free")
    runtime: tuple[str, ...] = ("eager",)
    batch: tuple[int, ...] = (1, 8)
    threads: tuple[int, ...] = (1,)


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelChoice(Choice):
    """A trained emulator.

    Args:
        emulator: In evaluation mode, on the choice's device.
    """

    emulator: Emulator
    kind: Kind = Kind.MODEL

    @property
    def identity(self) -> Mapping[str, Any]:
        return {
            "recipe": self.emulator.recipe.to_dict(),
            "weights": weights_digest(self.emulator.state_dict()),
            "device": self.device.type,
            "runtime": self.emulator.runtime.name,
        }

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Rollout:
        state = scenes.window(indices, 0).to(self.device).initial
        return lambda frames: rollout(self.emulator, state, frames)

    def computed_frames(self, frames: int) -> int:
        return -(-frames // self.emulator.frames) * self.emulator.frames  # whole bundles


def model_choices(
    settings: ModelSettings, name: str, emulator: Emulator, scenes: Scenes, device: torch.device
) -> Iterator[Choice]:
    """All forms of a model, rebuilt for these scenes if it was trained on others, see `EmulatorRecipe.over`.

    Args:
        settings: Of the forms; the first of each kind is not part of a form's name.
        name: Of the model.
        emulator: On the CPU.
        scenes: What is predicted.
        device: Where the forms compute.

    Raises:
        ConfigError: if the model cannot take the scenes, naming it and the reason; if there is no such runtime.
    """
    differing = emulator.scene.differences(scenes.scene)
    facts = {"model": name + OTHER_SCENES * bool(differing), "weights": short_digest(emulator.state_dict())}
    if differing:
        facts["scenes_differ_in"] = ", ".join(differing)
        try:
            emulator = emulator.over(scenes.scene)
        except ConfigError as error:
            raise ConfigError(f"The model {name} cannot predict the scenes of {scenes.name}. {error}") from error
    for precision, constraints, runtime in product(settings.precision, settings.constraints, settings.runtime):
        form = emulator.with_network(NETWORK_PRECISIONS[precision])
        form = form if constraints == "held" else form.unconstrained()
        form = form.to(device).with_runtime(runtime)
        for batch, threads in product(settings.batch, settings.threads):
            parts = {
                precision: precision != settings.precision[0],
                constraints: constraints != settings.constraints[0],
                runtime: runtime != settings.runtime[0],
                f"batch {batch}": batch != 1,
                counted(threads, "thread"): threads != settings.threads[0],
            }
            yield ModelChoice(
                name=", ".join([facts["model"], *(part for part, shown in parts.items() if shown)]),
                emulator=form,
                settings={
                    **facts,
                    "precision": precision,
                    "constraints": constraints,
                    "cells": "×".join(map(str, form.grid.shape)),
                    "runtime": runtime,
                },
                batch=batch,
                threads=threads,
                device=device,
            )
