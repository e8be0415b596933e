"""A sweep: what is compared and how it is measured, as YAML; and the choices that it makes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Literal

import torch

from nmpm._support.bounded_files import parse_yaml
from nmpm._support.messages import counted
from nmpm._support.plain_data import from_plain
from nmpm.emulator import Emulator
from nmpm.errors import ConfigError
from nmpm.evaluation.prediction_errors import Measures
from nmpm.evaluation.trade.choices import (
    CPU,
    Choice,
    Kind,
    Predictor,
    SimulatorChoice,
    digest,
    foreign_choice,
    trivial_choice,
)
from nmpm.evaluation.trade.models import ModelSettings, model_choices
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.scene import Scene
from nmpm.sim import Preset
from nmpm.sim.predictability import twin_of


@dataclass(frozen=True)
class Timing:
    """How choices are timed.

    Args:
        rounds: Timed rollouts of each choice, each of another scene.
        frames: Longest rollout; shorter where a scene comes to rest earlier, as resting scenes flatter.
    """

    rounds: int = 9
    frames: int = 200


@dataclass(frozen=True)
class SimulatorSettings:
    """Settings of the simulator, beside the shipped one.

    Args:
        coarser: Factors on the width of cells (SPH: on the spacing of particles); 1 is as shipped.
        substeps: Shares of the shipped number of substeps, which a coarser simulation divides by its factor. Those that
            turn out unstable are reported as such; `Preset.stable_substeps` is measured too.
    """

    coarser: tuple[int, ...] = (1, 2, 4)
    substeps: tuple[float, ...] = (1.0, 0.75, 0.5, 0.35, 0.25)


@dataclass(frozen=True)
class Floors:
    """Limits of accuracy: errors of the simulator compared with itself.

    Args:
        nudge: Noise on the initial positions, as a share of the domain's longest side; 0 for none.
        twin: Whether the simulator with half of its substeps is measured, see `nmpm.sim.predictability`.
    """

    nudge: float = 1e-6
    twin: bool = True


@dataclass(frozen=True)
class Sweep:
    """The choices to compare, and how they are measured.

    Args:
        scenes: Test scenes.
        measures: Errors.
        timing: Rounds and frames.
        models: Settings of models.
        simulator: Settings of the simulator.
        trivial: Trivial predictors.
        floors: Limits of accuracy.

    Raises:
        ConfigError: if a value is out of range.
    """

    scenes: int = 20
    measures: Measures = field(default_factory=Measures)
    timing: Timing = field(default_factory=Timing)
    models: ModelSettings = field(default_factory=ModelSettings)
    simulator: SimulatorSettings = field(default_factory=SimulatorSettings)
    trivial: tuple[Literal["nothing moves", "free fall"], ...] = ("nothing moves", "free fall")
    floors: Floors = field(default_factory=Floors)

    def __post_init__(self) -> None:
        positive: dict[str, Sequence[float]] = {
            "scenes": (self.scenes,),
            "measures.horizons": self.measures.horizons,
            "timing.rounds": (self.timing.rounds,),
            "timing.frames": (self.timing.frames,),
            "models.batch": self.models.batch,
            "models.threads": self.models.threads,
            "simulator.coarser": self.simulator.coarser,
            "simulator.substeps": self.simulator.substeps,
        }
        for key, values in positive.items():
            if min(values, default=1) <= 0:
                raise ConfigError(f"{key}: {min(values)!r} must be a positive number.")
        if max(self.models.batch, default=1) > self.scenes:
            raise ConfigError(f"models.batch: {max(self.models.batch)} scenes at once of {self.scenes} scenes in all.")

    def with_scenes(self, count: int) -> Sweep:
        """The sweep of another number of test scenes, without batches of more."""
        batch = tuple(batch for batch in self.models.batch if batch <= count) or (1,)
        return dataclasses.replace(self, scenes=count, models=dataclasses.replace(self.models, batch=batch))


def shipped_sweep_text(name: str) -> str:
    """The sweep of `nmpm trade` or `nmpm compare`, by the command's name, as YAML with comments."""
    return (resources.files(__package__) / f"{name}.yaml").read_text(encoding="utf-8")


def read_sweep(text: str, where: str) -> Sweep:
    """The sweep of a YAML text; what it leaves out is as `nmpm trade` has it.

    Args:
        text: Content of the file.
        where: Name of the file, for errors.

    Raises:
        DataError: if it is not plain YAML.
        ConfigError: naming the key that is unknown or wrong.
    """
    return from_plain(Sweep, parse_yaml(text, where), where)


def make_choices(
    sweep: Sweep,
    scenes: Scenes,
    models: Mapping[str, Emulator],
    device: torch.device = CPU,
    predictors: Sequence[Callable[[Scene], Predictor]] = (),
) -> list[Choice]:
    """All choices of a sweep; the first is the reference that times are compared with.

    Args:
        sweep: Settings.
        scenes: What is predicted; without simulator there are no choices of it, and no floors.
        models: Trained emulators on the CPU, by name; those of other scenes are rebuilt for these.
        device: Where they compute.
        predictors: Make those of other packages.

    Raises:
        ConfigError: if a model cannot take the scenes, there is no such setting, or two choices have one name.
    """
    choices: list[Choice] = []
    if scenes.preset is not None:
        choices += _simulators(sweep.simulator, scenes.preset)
        choices += _floors(sweep.floors, scenes.preset)
    for name, emulator in models.items():
        choices += _without_repetitions(model_choices(sweep.models, name, emulator, scenes, device))
    choices += [foreign_choice(make, scenes.scene) for make in predictors]
    choices += [trivial_choice(name, scenes.scene) for name in sweep.trivial]
    names = [choice.name for choice in choices]
    if repeated := next((name for name in names if names.count(name) > 1), None):
        raise ConfigError(f"Two choices are called {repeated!r}: leave one out, or give it another name.")
    return choices


def _simulators(settings: SimulatorSettings, preset: Preset) -> Iterator[Choice]:
    """The simulator as shipped, then the others; settings that the preset itself refuses are left out."""
    yield _simulator_choice(preset, 1)
    for factor in settings.coarser:
        try:
            coarse = preset.coarsened(factor) if factor > 1 else preset
        except ConfigError:
            continue
        counts = {math.ceil(share * preset.substeps / factor) for share in settings.substeps}
        for substeps in sorted(counts | {coarse.stable_substeps}, reverse=True):
            if (factor, substeps) == (1, preset.substeps):
                continue
            try:
                yield _simulator_choice(dataclasses.replace(coarse, substeps=substeps), factor)
            except ConfigError:  # a wave would skip cells or particles
                continue


def _simulator_choice(preset: Preset, factor: int, name: str = "", nudge: float = 0.0) -> SimulatorChoice:
    """The simulator on `factor` times as wide cells; a floor if it has a name."""
    coarse = "" if factor == 1 else f"1/{factor} resolution, "
    settings: dict[str, Any] = {
        "model": "simulator",
        "coarser": factor,
        "substeps": preset.substeps,
        "runtime": "numba",
        "precision": "float64",
    }
    return SimulatorChoice(
        name=name or f"simulator, {coarse}{counted(preset.substeps, 'substep')}",
        preset=preset,
        nudge=nudge,
        settings=settings | ({"nudge": nudge} if nudge else {}),
        kind=Kind.FLOOR if name else Kind.SIMULATOR,
    )


def _floors(floors: Floors, preset: Preset) -> Iterator[Choice]:
    if floors.twin:
        twin = twin_of(preset)
        yield _simulator_choice(twin, 1, f"twin: {twin.substeps} of {preset.substeps} substeps")
    if floors.nudge:
        yield _simulator_choice(preset, 1, f"simulator nudged by {floors.nudge:g}", floors.nudge)


def _without_repetitions(choices: Iterator[Choice]) -> Sequence[Choice]:
    """The first of those that predict the same in the same way, such as a model without constraints with them off."""
    first: dict[str, Choice] = {}
    for choice in choices:
        first.setdefault(digest([dict(choice.identity), choice.batch, choice.threads]), choice)
    return list(first.values())
