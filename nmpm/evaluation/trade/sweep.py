"""A sweep: what is compared, read from YAML."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import product
from types import MappingProxyType

import torch

from nmpm._support.bounded_files import parse_yaml
from nmpm._support.digests import short_digest
from nmpm._support.messages import counted
from nmpm._support.plain_data import from_plain
from nmpm.emulator import Emulator
from nmpm.errors import ConfigError
from nmpm.evaluation.gns import TrainedGraph
from nmpm.evaluation.trade.choice import CPU, OTHER_SCENES, Choice, Kind, digest
from nmpm.evaluation.trade.errors import Measures
from nmpm.evaluation.trade.graphs import graph_choices
from nmpm.evaluation.trade.models import (
    ModelChoice,
    over_scenes,
    with_cells,
    with_constraints,
    with_precision,
)
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.simulators import SimulatorChoice
from nmpm.evaluation.trade.timing import Timing
from nmpm.evaluation.trade.trivial import PREDICTORS, TrivialChoice
from nmpm.sim import Preset


@dataclass(frozen=True)
class ModelSettings:
    """Settings of every model; all combinations of them are measured.

    Args:
        precision: Precisions of the network, see `nmpm.emulator.NETWORK_PRECISIONS`.
        constraints: "held" and "free", see `models.CONSTRAINTS`.
        cells: Factors on the number of grid cells along each axis, relative to training.
        runtime: What computes the network, see `nmpm.emulator.runtimes.RUNTIMES`.
        batch: Batch sizes, in scenes.
        threads: Numbers of torch's threads.
    """

    precision: tuple[str, ...] = ("float32", "bfloat16")
    constraints: tuple[str, ...] = ("held", "free")
    cells: tuple[float, ...] = (1.0,)
    runtime: tuple[str, ...] = ("eager",)
    batch: tuple[int, ...] = (1, 8)
    threads: tuple[int, ...] = (1,)


@dataclass(frozen=True)
class SimulatorSettings:
    """Settings of the simulator.

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
        twin: Share of the simulator's substeps that its twin takes; 0 for no twin.
    """

    nudge: float = 1e-6
    twin: float = 0.5


@dataclass(frozen=True)
class Sweep:
    """What is compared, and how it is measured.

    Args:
        scenes: Test scenes.
        measures: Errors.
        timing: Rounds and frames.
        models: Settings of models.
        simulator: Settings of the simulator.
        trivial: Trivial predictors, see `trivial.PREDICTORS`.
        floors: Limits of accuracy.

    Raises:
        ConfigError: if a value is out of range.
    """

    scenes: int = 20
    measures: Measures = field(default_factory=Measures)
    timing: Timing = field(default_factory=Timing)
    models: ModelSettings = field(default_factory=ModelSettings)
    simulator: SimulatorSettings = field(default_factory=SimulatorSettings)
    trivial: tuple[str, ...] = tuple(PREDICTORS)
    floors: Floors = field(default_factory=Floors)

    def __post_init__(self) -> None:
        unknown = sorted(set(self.trivial) - set(PREDICTORS))
        if unknown:
            raise ConfigError(f"trivial: {', '.join(unknown)}; there are {', '.join(PREDICTORS)}.")
        positive = {
            "scenes": (self.scenes,),
            "measures.horizons": self.measures.horizons,
            "models.cells": self.models.cells,
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


def default_sweep_text() -> str:
    """The shipped sweep as YAML, with its comments."""
    return (resources.files(__package__) / "default.yaml").read_text(encoding="utf-8")


def read_sweep(text: str, where: str) -> Sweep:
    """The sweep of a YAML text; what it leaves out is as shipped.

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
    graphs: Mapping[str, TrainedGraph] = MappingProxyType({}),
) -> list[Choice]:
    """All choices of a sweep; the first is the reference that times are compared with.

    Args:
        sweep: Settings.
        scenes: What is predicted; without simulator there are no choices of it, and no floors.
        models: Trained emulators on the CPU, by name; those of other scenes are rebuilt for these.
        device: Where they compute.
        graphs: Trained graph simulators, by name.

    Raises:
        ConfigError: if a model cannot take the scenes, or there is no such setting.
    """
    choices: list[Choice] = []
    if scenes.preset is not None:
        choices += _simulators(sweep.simulator, scenes.preset)
        choices += _floors(sweep.floors, scenes.preset)
    for name, emulator in models.items():
        over = over_scenes(name, emulator, scenes)
        shown = name if over is emulator else name + OTHER_SCENES
        known = {"model": shown, "weights": short_digest(emulator.state_dict())}
        choices += _without_repetitions(_models(sweep.models, known, over, device))
    choices += graph_choices(graphs, scenes)
    choices += [TrivialChoice(name) for name in sweep.trivial]
    return choices


def _simulators(settings: SimulatorSettings, preset: Preset) -> Iterator[Choice]:
    """The simulator as shipped, then the others; settings that the preset itself refuses are left out."""
    yield SimulatorChoice(_simulator_name(1, preset.substeps), preset, _simulator_settings(1, preset.substeps))
    for factor in settings.coarser:
        try:
            coarse = preset.coarsened(factor) if factor > 1 else preset
        except ConfigError:
            continue
        asked = {math.ceil(share * preset.substeps / factor) for share in settings.substeps}
        for substeps in sorted(asked | {coarse.stable_substeps}, reverse=True):
            if (factor, substeps) == (1, preset.substeps):
                continue
            changed = _with_substeps(coarse, substeps)
            if changed is not None:
                name = _simulator_name(factor, substeps)
                yield SimulatorChoice(name, changed, _simulator_settings(factor, substeps))


def _with_substeps(preset: Preset, substeps: int) -> Preset | None:
    """The preset with so many substeps, stable or not; None if it refuses, as a wave then skips cells or particles."""
    try:
        return dataclasses.replace(preset, substeps=substeps)
    except ConfigError:
        return None


def _simulator_name(factor: int, substeps: int) -> str:
    coarse = "" if factor == 1 else f"1/{factor} resolution, "
    return f"simulator, {coarse}{counted(substeps, 'substep')}"


def _simulator_settings(factor: int, substeps: int) -> dict[str, str | int | float]:
    return {"model": "simulator", "coarser": factor, "substeps": substeps, "runtime": "numba", "precision": "float64"}


def _floors(floors: Floors, preset: Preset) -> Iterator[Choice]:
    substeps = math.ceil(floors.twin * preset.substeps)
    twin = _with_substeps(preset, substeps) if floors.twin else None
    if twin is not None:
        name, settings = f"twin: {substeps} of {preset.substeps} substeps", _simulator_settings(1, substeps)
        yield SimulatorChoice(name, twin, settings, kind=Kind.FLOOR)
    if floors.nudge:
        settings = _simulator_settings(1, preset.substeps) | {"nudge": floors.nudge}
        name = f"simulator nudged by {floors.nudge:g}"
        yield SimulatorChoice(name, preset, settings, floors.nudge, kind=Kind.FLOOR)


def _models(
    settings: ModelSettings, known: Mapping[str, str], emulator: Emulator, device: torch.device
) -> Iterator[Choice]:
    """All forms of a model.

    Args:
        settings: Of the forms.
        known: Columns that all of them share: the model's name and weights.
        emulator: On the CPU.
        device: Where they compute.
    """
    forms = product(settings.precision, settings.constraints, settings.cells, settings.runtime)
    for precision, constraints, cells, runtime in forms:
        plain = with_cells(with_constraints(with_precision(emulator, precision), constraints), cells)
        form = plain.to(device).with_runtime(runtime)
        for batch, threads in product(settings.batch, settings.threads):
            parts = {
                precision: precision != settings.precision[0],
                constraints: constraints != settings.constraints[0],
                f"{cells:g} × cells": cells != 1,
                runtime: runtime != settings.runtime[0],
                f"batch {batch}": batch != 1,
                counted(threads, "thread"): threads != settings.threads[0],
            }
            yield ModelChoice(
                name=", ".join([known["model"], *(part for part, shown in parts.items() if shown)]),
                emulator=form,
                settings={
                    **known,
                    "precision": precision,
                    "constraints": constraints,
                    "cells": "×".join(map(str, form.grid.shape)),
                    "runtime": runtime,
                },
                batch=batch,
                threads=threads,
                device=device,
            )


def _without_repetitions(choices: Iterator[Choice]) -> Sequence[Choice]:
    """The first of those that predict the same in the same way, such as a model without constraints with them off."""
    found: dict[str, Choice] = {}
    for choice in choices:
        found.setdefault(digest([dict(choice.identity), choice.batch, choice.threads]), choice)
    return list(found.values())
