"""The predictors of a comparison: the simulator and its twin, models rebuilt over the scenes, trivial predictors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from nmpm.emulator import Emulator
from nmpm.evaluation.trade.choice import CPU, Choice, Kind
from nmpm.evaluation.trade.models import ModelChoice, over_scenes
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.simulators import SimulatorChoice
from nmpm.evaluation.trade.trivial import PREDICTORS, TrivialChoice
from nmpm.sim.predictability import twin_of


@dataclass(frozen=True)
class Candidate:
    """A predictor, and the facts in which the scenes differ from those of its training.

    Args:
        choice: The predictor.
        differing: Names of the facts in which the scenes differ from those of the model's training; empty where none
            does, and for predictors that are not trained.
    """

    choice: Choice
    differing: tuple[str, ...] = ()

    @property
    def reproduces(self) -> bool:
        """Whether it is the simulator that made the scenes, as shipped, whose error is 0."""
        return self.choice.kind is Kind.SIMULATOR


def make_predictors(scenes: Scenes, models: Mapping[str, Emulator], device: torch.device = CPU) -> list[Candidate]:
    """The simulator of the scenes, if it is known, and its twin; the models; the trivial predictors.

    A model of other scenes is rebuilt over these, with grid cells of the size it was trained with, see
    `EmulatorRecipe.over`. The twin is the simulator with other substeps, see `nmpm.sim.predictability`: its error is
    an estimate of the simulator's own.

    Args:
        scenes: What is predicted.
        models: Trained emulators by name.
        device: Where models compute.

    Raises:
        ConfigError: if a model cannot take the scenes, naming it and the reason.
    """
    simulators = [Candidate(choice) for choice in _simulators(scenes)]
    trained = [_model(name, emulator, scenes, device) for name, emulator in models.items()]
    return [*simulators, *trained, *(Candidate(TrivialChoice(name)) for name in PREDICTORS)]


def _model(name: str, emulator: Emulator, scenes: Scenes, device: torch.device) -> Candidate:
    adapted = over_scenes(name, emulator, scenes)
    settings = {"model": name, "cells": "×".join(map(str, adapted.grid.shape))}
    choice = ModelChoice(name, adapted.to(device), settings, device=device)
    return Candidate(choice, emulator.scene.differences(scenes.scene))


def _simulators(scenes: Scenes) -> list[Choice]:
    preset = scenes.preset
    if preset is None:
        return []
    shipped = SimulatorChoice(f"simulator, {preset.substeps} substeps", preset, _settings(preset.substeps))
    twin = twin_of(preset)
    name = f"twin, {twin.substeps} substeps"
    return [shipped, SimulatorChoice(name, twin, _settings(twin.substeps), kind=Kind.FLOOR)]


def _settings(substeps: int) -> dict[str, Any]:
    return {"model": "simulator", "substeps": substeps}
