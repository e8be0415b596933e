"""Models as they predict the scenes of a comparison: as they are, over another domain, or matched by similarity."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from nmpm._support.digests import short_digest
from nmpm.emulator import Emulator
from nmpm.emulator.similarity import find_match
from nmpm.errors import ConfigError
from nmpm.evaluation.matched import MatchFinder, describe_match, is_plain
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


def fit_to_scenes(name: str, emulator: Emulator, scenes: Scenes, find: MatchFinder = find_match) -> FittedModel:
    """A model for scenes that need not be its own.

    Args:
        name: Of the model.
        emulator: The model.
        scenes: What it is to predict.
        find: `find_match`, or that with some of its arguments given.

    Raises:
        ConfigError: if they cannot be matched, naming the model and the reason.

    Warns:
        UserWarning: of what could not be matched.
    """
    differing, weights = emulator.scene.differences(scenes.scene), short_digest(emulator.state_dict())
    if not differing and emulator.scene.materials == scenes.scene.materials:
        return FittedModel(name, weights, emulator)
    try:
        match = find(emulator, scenes.scene, scenes.motion, names=(name, scenes.name))
    except ConfigError as error:
        raise ConfigError(f"The model {name} cannot predict the scenes of {scenes.name}. {error}") from error
    ours, theirs = match.reading.scene, scenes.scene
    if is_plain(match.reading) and (ours.materials, ours.gravity_known) == (theirs.materials, theirs.gravity_known):
        return FittedModel(name, weights, emulator.matched(match), ", ".join(differing))
    for warning in match.warnings:
        warnings.warn(warning, stacklevel=3)
    facts = f"{', '.join(differing) or 'materials'}; taken as {describe_match(emulator, match)}"
    return FittedModel(name, weights, emulator.matched(match), facts, match.reading)
