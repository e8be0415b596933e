"""Models as they predict the scenes of a comparison: as they are, over another domain, or matched by similarity."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

from nmpm._support.digests import short_digest
from nmpm._support.messages import counted
from nmpm.emulator import Emulator
from nmpm.emulator.similarity import Match, find_match
from nmpm.errors import ConfigError
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.scene import Reading


@dataclass(frozen=True)
class FittedModel:
    """A model as it predicts some scenes.

    Args:
        name: Of the model.
        weights: Digest of its weights.
        emulator: For the scenes, or for `reading.scene`.
        differing: In what they differ from those of its training, or how they are matched; empty where they do not.
        reading: How scenes of another kind are read; None for others.
    """

    name: str
    weights: str
    emulator: Emulator
    differing: str = ""
    reading: Reading | None = None


def fit_to_scenes(
    name: str,
    emulator: Emulator,
    scenes: Scenes,
    materials: Mapping[str, str] | None = None,
    stride: Fraction | None = None,
    strict: bool = False,
) -> FittedModel:
    """A model for scenes that need not be its own.

    Args:
        name: Of the model.
        emulator: The model.
        scenes: What it is to predict.
        materials: The model's by the data's name, as for `find_match`; left out for a model that lacks one of them.
        stride: As for `find_match`.
        strict: Likewise.

    Raises:
        ConfigError: if they cannot be matched, naming the model and the reason.

    Warns:
        UserWarning: of what could not be matched.
    """
    differing, weights = emulator.scene.differences(scenes.scene), short_digest(emulator.state_dict())
    if not differing and not emulator.scene.aliases and emulator.scene.materials == scenes.scene.materials:
        return FittedModel(name, weights, emulator)
    has_materials = set((materials or {}).values()) <= set(emulator.scene.materials)
    given = materials if has_materials else None
    try:
        match = find_match(emulator, scenes.scene, scenes.motion, given, stride, strict, (name, scenes.name))
    except ConfigError as error:
        raise ConfigError(f"The model {name} cannot predict the scenes of {scenes.name}. {error}") from error
    ours, theirs = match.reading.scene, scenes.scene
    same_facts = (ours.materials, ours.gravity_known) == (theirs.materials, theirs.gravity_known)
    if match.reading == Reading(ours) and same_facts:
        return FittedModel(name, weights, emulator.matched(match), ", ".join(differing))
    for warning in match.warnings:
        warnings.warn(warning, stacklevel=3)
    facts = f"{', '.join(differing) or 'materials'}; taken as {_in_short(match)}"
    return FittedModel(name, weights, emulator.matched(match), facts, match.reading)


def _in_short(match: Match) -> str:
    """A match in a phrase: "4 frames for 1 of the data, gravity × 1.02"."""
    gravity = "" if match.gravity is None else f", gravity × {match.gravity:.3g}"
    return f"{counted(match.reading.between, 'frame')} for {match.reading.every} of the data{gravity}"
