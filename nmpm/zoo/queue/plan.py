"""What the queue trains, read from its YAML file, and the commands of its trainings."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

from nmpm._support.bounded_files import read_yaml
from nmpm._support.messages import suggestion
from nmpm._support.plain_data import from_plain
from nmpm._support.shipped import find_config
from nmpm.errors import ConfigError
from nmpm.zoo.registry import check_name

OPEN = "???"
"""Placeholder in a configuration for a value that the user has to give."""
RATE = "model.optimizer.init_args.lr"
"""Key of the learning rate in a configuration."""
_BUDGET = ("trainer.max_steps", "trainer.max_time", "trainer.val_check_interval")
_NOT_OF_RECIPE = frozenset({*_BUDGET, RATE, "config", "start_from", "data.path"})
VALIDATIONS = 30
"""Validations in a training: points of the curve on the card."""


@dataclass(frozen=True)
class Extension:
    """How a training goes on from its best weights.

    Args:
        hours: Of each extension.
        rate: Factor on the configuration's learning rate.
        gain: Relative improvement of the validation error per extension below which a dataset stops; negative not to
            stop for it.
        limit: Hours of all trainings of a dataset.

    Raises:
        ConfigError: if a value is not a finite number, or outside of its range.
    """

    hours: float = 1.0
    rate: float = 0.5
    gain: float = 0.03
    limit: float = 5.0

    def __post_init__(self) -> None:
        for name in ("hours", "rate", "limit"):
            if getattr(self, name) < 0:
                raise ConfigError(f"extension: {name} = {getattr(self, name)} should not be below 0.")
        if self.gain >= 1:
            raise ConfigError(f"extension: gain = {self.gain} is a share, such as 0.03 for 3%.")
        if self.rate == 0:
            raise ConfigError("extension: rate = 0 trains nothing.")


@dataclass(frozen=True)
class Dataset:
    """A dataset of the queue.

    Args:
        name: Of its folder and of its entry in the zoo.
        config: Configuration of `nmpm fit`, as `--config` takes it.
        hours: Of the first training.
        publish: Whether its model goes into the zoo.
        options: Further values of the configuration, by dotted keys.
        extend: Values in place of these in trainings that go on from weights of the same dataset, such as more
            trajectories.
        about: Description of the data on the card, beside their name.
        goal: What the full-rollout MSE on the test split is meant to be, in domain length squared; for the card.
        start: Another dataset of the queue, whose best weights the first training starts from, at the extension's rate,
            where the zoo has no entry to go on from.
    """

    name: str
    config: str
    hours: float
    publish: bool = True
    options: Mapping[str, Any] = field(default_factory=dict)
    extend: Mapping[str, Any] = field(default_factory=dict)
    about: str = ""
    goal: float | None = None
    start: str = ""

    def __post_init__(self) -> None:
        check_name(self.name)
        for name, value in (("hours", self.hours), ("goal", 1.0 if self.goal is None else self.goal)):
            if value <= 0:
                raise ConfigError(f"{self.name}: {name} = {value} must be a positive number.")

    def extended(self) -> Dataset:
        """The dataset as trainings see it that go on from its weights."""
        return dataclasses.replace(self, options={**self.options, **self.extend}, extend={})

    def recipe(self) -> dict[str, str]:
        """The options as words of `nmpm fit`: what tells one kind of training from another, see `recipe_of`."""
        return recipe_of(_words(self.config, self.hours, self.options))

    def generation(self) -> tuple[str, dict[str, Any]] | None:
        """Name and options of the simulated data, as `nmpm.data.catalog.ensure` takes them; None for recorded data."""
        data = self._data()
        if data.get("path") is not None or data.get("name") is None or data.get("source", "disk") != "disk":
            return None
        return str(data["name"]), dict(data.get("generate") or {})

    @property
    def lacks_data(self) -> bool:
        """Whether the configuration leaves the folder of recorded data open."""
        data = self._data()
        return data.get("path") == OPEN and data.get("name") is None

    def _data(self) -> dict[str, Any]:
        """The values under `data`."""
        own = {key.removeprefix("data."): value for key, value in self.options.items() if key.startswith("data.")}
        return {**self._configuration().get("data", {}), **own}

    def learning_rate(self) -> float:
        """That of the options, or of the configuration.

        Raises:
            ConfigError: if neither states one.
        """
        try:
            return float(self.options.get(RATE) or self._configuration()["model"]["optimizer"]["init_args"]["lr"])
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"{self.config}: {RATE} is needed to extend a training.") from error

    def _configuration(self) -> dict[str, Any]:
        return read_yaml(find_config(self.config))


@dataclass(frozen=True)
class Plan:
    """Datasets in the order in which they are trained."""

    datasets: tuple[Dataset, ...]
    extension: Extension = Extension()

    @classmethod
    def read(cls, path: Path) -> Self:
        """The plan of a YAML file.

        Raises:
            ConfigError: if it lacks a key or has an unknown one, a name occurs twice, or a dataset starts from one that
                is not in the file, or from itself.
            DataError: if it cannot be read.
        """
        plan = from_plain(cls, read_yaml(path), str(path))
        names = [dataset.name for dataset in plan.datasets]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ConfigError(f"{path}: {', '.join(twice)}: occurs twice.")
        for dataset in plan.datasets:
            _check_start(path, dataset, names)
        return plan

    def with_data(self, folders: Mapping[str, str]) -> Plan:
        """The plan with the folders of recorded data, by the datasets' names.

        Raises:
            ConfigError: if there is no dataset of a name.
        """
        self.select(list(folders))
        found = tuple(
            dataclasses.replace(d, options={**d.options, "data.path": folders[d.name]}) if d.name in folders else d
            for d in self.datasets
        )
        return Plan(found, self.extension)

    def select(self, names: list[str]) -> Plan:
        """The plan with these datasets only, in its own order; all of them where no name is given.

        Raises:
            ConfigError: if there is no dataset of a name.
        """
        known = {dataset.name for dataset in self.datasets}
        unknown = sorted(set(names) - known)
        if unknown:
            raise ConfigError(f"The queue has no {', '.join(unknown)}; it has {', '.join(sorted(known))}.")
        return Plan(tuple(d for d in self.datasets if not names or d.name in names), self.extension)


def _check_start(path: Path, dataset: Dataset, names: list[str]) -> None:
    others = [name for name in names if name != dataset.name]
    if dataset.start and dataset.start not in others:
        near = suggestion(str(dataset.start), others)
        raise ConfigError(f"{path}: {dataset.name}: start = {dataset.start} is no other dataset of this queue.{near}")


def new_training(dataset: Dataset) -> list[str]:
    """The arguments of `nmpm` for a training from random weights, without its folder and device."""
    return _words(dataset.config, dataset.hours, dataset.options)


def continued_training(dataset: Dataset, hours: float, rate: float, best: Path) -> list[str]:
    """The arguments of `nmpm` for a training from the weights of a checkpoint, at `rate` times the learning rate."""
    start = {RATE: rate * dataset.learning_rate(), "start_from": str(best)}
    return _words(dataset.config, hours, {**dataset.options, **start})


def _words(config: str, hours: float, options: Mapping[str, Any]) -> list[str]:
    # Time alone ends the training, so that the learning rate comes down with it; configurations may state steps too.
    budget = dict(zip(_BUDGET, (-1, _duration(3600 * hours), _duration(3600 * hours / VALIDATIONS)), strict=True))
    words = ["fit", "--config", config]
    for key, value in {**budget, **options}.items():
        words += [f"--{key}", value if isinstance(value, str) else json.dumps(value)]
    return words


def recipe_of(words: Sequence[str]) -> dict[str, str]:
    """The options of a training's command without its time, learning rate, starting weights and folder of the data."""
    options = {key.removeprefix("--"): value for key, value in pairwise(words) if key.startswith("--")}
    return {key: value for key, value in options.items() if key not in _NOT_OF_RECIPE}


def _duration(seconds: float) -> str:
    """Seconds as DD:HH:MM:SS, at least one."""
    whole = timedelta(seconds=max(1, round(seconds)))
    hours, rest = divmod(whole.seconds, 3600)
    return f"{whole.days:02}:{hours:02}:{rest // 60:02}:{rest % 60:02}"
