"""Trainings and evaluations of a model on data that need not be of its kind: its form, and how the data are read."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jsonargparse import Namespace

from nmpm._support.plain_data import to_plain
from nmpm.cli.options import MatchOptions, describe
from nmpm.cli.training_options import read_options, stated_keys
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.dataset import Dataset
from nmpm.data.sources import FolderSource
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.adaptation import adapted, with_members
from nmpm.emulator.similarity import Match
from nmpm.errors import ConfigError, NmpmError
from nmpm.scene import Reading, Scene
from nmpm.training.checkpoints import COMPARED, read_checkpoint
from nmpm.zoo.entries import load_checkpoint
from nmpm.zoo.matching import match_data
from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.registry import load_model

FORM = (*COMPARED, "constraints", "particles_per_cell")
"""Arguments of --model.… that are the model's."""


@dataclass(frozen=True)
class MatchedRun:
    """A model that a training starts from, or whose checkpoint is evaluated on other data.

    Args:
        model: On the data.
        match: With them.
        scene: Of the data, as they are.
        different: Arguments of the configuration that are not the model's, which take their place.
        left_out: Those of them that the configuration or an option states.
        chosen: The model's material by the data's name, where neither options nor names tell; see `nmpm zoo match`.
    """

    model: Pretrained
    match: Match
    scene: Scene
    different: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    chosen: Mapping[str, str] | None = None

    @classmethod
    def of(cls, config: Namespace, given: MatchOptions, checkpoint: Path | None) -> MatchedRun | None:
        """The match of the model of `start_from`, or of a checkpoint where the data are not of its kind.

        Raises:
            ConfigError: if model and data cannot be matched.
        """
        start = config.get("start_from")
        if (start is None or config["ckpt_path"]) and checkpoint is None:
            return None
        data = TrajectoryDataModule(**config["data"].as_dict())
        if checkpoint is None and isinstance(data.data_source, FolderSource):
            data.data_source.split("train")  # refuses data without, before they are measured
        stored = stored_scene(checkpoint) if checkpoint else None
        if checkpoint and (not stored or (stored.aliases == data.scene.aliases and not stored.differences(data.scene))):
            return None
        model = load_model(str(start)) if checkpoint is None else load_checkpoint(checkpoint)
        if checkpoint is None:
            recipe = with_members(model.emulator.recipe, config["model"]["members"])
            model = dataclasses.replace(model, emulator=adapted(model.emulator, recipe))
        chosen = None
        try:
            match = match_data(model.emulator, model.name, data, *given)
        except ConfigError:
            chosen = _choose_materials(model, data, given) if checkpoint is None else None
            if chosen is None:
                raise
            match = match_data(model.emulator, model.name, data, *given._replace(materials=chosen))
        different = tuple(key for key in FORM if _differs(config["model"][key], match.recipe, key))
        stated = stated_keys(read_options(sys.argv[2:]), "model") if checkpoint is None else set()
        left_out = tuple(key for key in different if key in stated)
        return cls(model.matched(match), match, data.scene, different, left_out, chosen)

    def __str__(self) -> str:
        """Lines on how the model takes the data, and on what is left out of the configuration; none if neither."""
        how = describe(self.match, self.model.name) if not self._is_same_kind or self.match.warnings else ""
        if self.chosen:
            pairs = ",".join(f"{name}={to}" for name, to in self.chosen.items())
            how += f"Chosen by short rollouts, as nmpm zoo match does: --materials {pairs}\n"
        if not self.left_out:
            return how
        names = ", ".join(f"model.{name}" for name in self.left_out)
        return f"{how}Left out of the configuration, as {self.model.name} has its own: {names}.\n"

    @property
    def _is_same_kind(self) -> bool:
        return self.match.reading == Reading(self.scene)

    def complete(self, config: Namespace) -> None:
        """Put the model's form, and how the data are read, into a configuration."""
        plain = self.match.recipe.to_dict()
        for key in self.different:
            config["model"][key] = _namespace(plain.get(key))
        if "horizon" in config["data"]:  # at least to the next frame that the data have
            unroll = max(config["model"]["unroll"], -(-self.match.reading.between // plain["frames"]))
            config["model"]["unroll"], config["data"]["horizon"] = unroll, plain["frames"] * unroll
        if not self._is_same_kind:
            reading = self.match.reading
            config["data"]["reading"] = to_plain(reading) | {"scene": reading.scene.to_dict()}


def _choose_materials(model: Pretrained, data: TrajectoryDataModule, given: MatchOptions) -> Mapping[str, str] | None:
    """The materials of recorded data by which a model predicts them best; None where they are not what is missing."""
    if given.materials is not None or not isinstance(data.data_source, FolderSource):
        return None
    from nmpm.zoo.ranking import Ranking, Trial  # (the simulators compile kernels by numba)

    trial = Trial.of(Dataset(data.data_source))
    return Ranking(trial, stride=given.stride).best(model.name, model.emulator).stated


def stored_scene(checkpoint: Path) -> Scene | None:
    """The scene of a checkpoint's model; None for one that cannot be read, which is refused when it is loaded."""
    try:
        stored = read_checkpoint(checkpoint).get("hyper_parameters", {}).get("scene")
        return Scene.from_dict(stored) if isinstance(stored, dict) else None
    except NmpmError:
        return None


def _namespace(plain: Any) -> Any:
    """Mappings as jsonargparse's namespaces, nested ones too."""
    if isinstance(plain, Mapping):
        return Namespace(**{key: _namespace(value) for key, value in plain.items()})  # type: ignore[no-untyped-call]  # (jsonargparse has no types there)
    return plain


def _differs(configured: Any, recipe: EmulatorRecipe, key: str) -> bool:
    """Whether a configured part of a recipe is another than the recipe's, or none that it could have."""
    changed: dict[str, Any] = {key: configured.as_dict() if isinstance(configured, Namespace) else configured}
    try:
        return bool(getattr(dataclasses.replace(recipe, **changed), key) != getattr(recipe, key))
    except ConfigError:
        return True
