"""What is compared: models taken to the scenes of a dataset, its simulator, and trivial predictors."""

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
from nmpm.sim.twin import twin_of


@dataclass(frozen=True)
class Candidate:
    """Something that predicts scenes, and how far from its own scenes they are.

    Args:
        choice: What predicts.
        differing: Facts of the scenes that are not those of the model's training, by name; empty at home, and for all
            that is not trained.
    """

    choice: Choice
    differing: tuple[str, ...] = ()

    @property
    def reproduces(self) -> bool:
        """Whether it made the scenes, so that it has no error: the simulator as shipped."""
        return self.choice.kind is Kind.SIMULATOR


def make_predictors(scenes: Scenes, models: Mapping[str, Emulator], device: torch.device = CPU) -> list[Candidate]:
    """The simulator of the scenes, if it is known, and its twin; the models; the trivial predictors.

    A model of other scenes is rebuilt over these, with grid cells of the size it was trained with, see
    `EmulatorRecipe.over`. The twin is the simulator with other substeps, see `nmpm.sim.twin`: what its own results are
    uncertain by.

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
