"""A sweep: what is compared and how it is measured, as YAML; and the choices that it makes."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from importlib import resources
from importlib.util import find_spec
from itertools import product
from typing import Any, Literal

import torch

from nmpm._support.bounded_files import parse_yaml
from nmpm._support.machine import computes_bfloat16
from nmpm._support.messages import counted, install
from nmpm._support.plain_data import from_plain
from nmpm.emulator import NETWORK_PRECISIONS, Emulator
from nmpm.emulator.digests import weights_digest
from nmpm.emulator.members import nudge_of
from nmpm.emulator.similarity import Match, find_match
from nmpm.errors import ConfigError
from nmpm.evaluation.comparison import free_fall, still
from nmpm.evaluation.matched import MatchedPredictor
from nmpm.evaluation.prediction_errors import Measures
from nmpm.evaluation.trade.choices import (
    CPU,
    Choice,
    Kind,
    MembersChoice,
    ModelChoice,
    Predictor,
    PredictorChoice,
    SimulatorChoice,
    digest,
)
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.scene import Reading, Scene
from nmpm.sim import Preset
from nmpm.sim.preset import twin_of

Precision = Literal["float32", "bfloat16"]
EAGER, OPENVINO = "eager", "openvino"


@dataclass(frozen=True)
class ModelSettings:
    """Settings of every model; all combinations of them are measured.

    Args:
        precision: Precisions of the network; bfloat16 is left out on processors that emulate it, unless it is the only
            one.
        constraints: "held", with the model's constraints, and "free", without them.
        runtime: What computes the network, see `nmpm.backends.RUNTIMES`; None for torch and, on a CPU,
            OpenVINO if it is installed.
        batch: Batch sizes, in scenes.
        members: Rollouts of each scene by a model's first form, which stand beside it as an ensemble; 0 for none.
    """

    precision: tuple[Precision, ...] = ("float32", "bfloat16")
    constraints: tuple[Literal["held", "free"], ...] = ("held", "free")
    runtime: tuple[str, ...] | None = None
    batch: tuple[int, ...] = (1, 8)
    members: int = 0

    def precisions(self, device: torch.device) -> tuple[Precision, ...]:
        """Those that a device does not emulate; all if it emulates all."""
        computed = tuple(name for name in self.precision if name != "bfloat16" or computes_bfloat16(device))
        return computed or self.precision

    def runtimes(self, device: torch.device) -> tuple[str, ...]:
        """Names of those that are stated, or else installed."""
        if self.runtime is not None:
            return self.runtime
        return (EAGER, OPENVINO) if device.type == "cpu" and find_spec(OPENVINO) else (EAGER,)

    def left_out(self, device: torch.device) -> list[str]:
        """What is not measured on a device, in sentences."""
        lines = []
        if self.precisions(device) != self.precision:
            lines.append("bfloat16 is left out: this processor emulates it, which takes longer than float32.")
        if self.runtime is None and device.type == "cpu" and self.runtimes(device) == (EAGER,):
            lines.append(f"OpenVINO, often the faster runtime, is left out: {install('openvino')} adds it.")
        return lines


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
    """A model for scenes that need not be its own; warns of what could not be matched.

    Materials (left out for a model that lacks one of them), stride and strict are those of `find_match`.

    Raises:
        ConfigError: if they cannot be matched, naming the model and the reason.
    """
    differing, weights = emulator.scene.differences(scenes.scene), weights_digest(emulator.state_dict())[:12]
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


OTHER_SCENES = " (of other scenes)"
"""Ends the name of a model that was trained on other scenes, in the settings."""


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
    """Settings of the simulator, beside the shipped one and its twin, see `nmpm.sim.preset`.

    Args:
        coarser: Further factors on the width of cells (SPH: on the spacing of particles), beside 1.
        substeps: Shares of the shipped number of substeps, which a coarser simulation divides by its factor. Those that
            turn out unstable are reported as such; `Preset.stable_substeps` and the twin's are measured too.
        nudge: Noise on the initial positions, as a share of the domain's longest side, that shows how sensitive the
            scenes are; 0 for none.
    """

    coarser: tuple[int, ...] = (2, 4)
    substeps: tuple[float, ...] = (1.0, 0.75, 0.5, 0.35, 0.25)
    nudge: float = 1e-6


@dataclass(frozen=True)
class Sweep:
    """The choices to compare, and how they are measured.

    Raises:
        ConfigError: if a value is out of range.
    """

    scenes: int = 20
    measures: Measures = field(default_factory=Measures)
    timing: Timing = field(default_factory=Timing)
    models: ModelSettings = field(default_factory=ModelSettings)
    simulator: SimulatorSettings = field(default_factory=SimulatorSettings)

    def __post_init__(self) -> None:
        positive: dict[str, Sequence[float]] = {
            "scenes": (self.scenes,),
            "measures.horizons": self.measures.horizons,
            "timing.rounds": (self.timing.rounds,),
            "timing.frames": (self.timing.frames,),
            "models.batch": self.models.batch,
            "simulator.coarser": self.simulator.coarser,
            "simulator.substeps": self.simulator.substeps,
        }
        for key, values in positive.items():
            if min(values, default=1) <= 0:
                raise ConfigError(f"{key}: {min(values)!r} must be a positive number.")
        if self.models.members < 0:
            raise ConfigError(f"models.members: {self.models.members!r} must be 0 or more.")
        if max(self.models.batch, default=1) > self.scenes:
            raise ConfigError(f"models.batch: {max(self.models.batch)} scenes at once of {self.scenes} scenes in all.")

    def with_scenes(self, count: int) -> Sweep:
        """The sweep of another number of test scenes, without batches of more."""
        batch = tuple(batch for batch in self.models.batch if batch <= count) or (1,)
        return dataclasses.replace(self, scenes=count, models=dataclasses.replace(self.models, batch=batch))

    def with_members(self, count: int) -> Sweep:
        """The sweep with ensembles of so many members, and the fair CRPS of all choices."""
        models = dataclasses.replace(self.models, members=count)
        return dataclasses.replace(self, models=models, measures=dataclasses.replace(self.measures, crps=True))


def shipped_sweep_text(name: str) -> str:
    """The sweep of `nmpm trade` or `nmpm compare`, by the command's name, as YAML with comments."""
    return (resources.files(__package__) / f"{name}.yaml").read_text(encoding="utf-8")


def read_sweep(text: str, where: str) -> Sweep:
    """The sweep of a YAML text; what it leaves out is as `nmpm trade` has it. Errors name the file `where`.

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
    nudges: Mapping[str, float] | None = None,
    **match: Any,
) -> list[Choice]:
    """All choices of a sweep; of scenes without simulator there are no choices of it, and no floors.

    Args:
        sweep: Settings.
        scenes: What is predicted.
        models: Trained emulators on the CPU, by name; those of other scenes are rebuilt for these.
        device: Where they compute.
        predictors: Make those of other packages.
        nudges: Cells by which the starts of a model's members are displaced, by name; the usual ones for others.
        match: `materials`, `stride` and `strict` of `fit_to_scenes`.

    Raises:
        ConfigError: if a model cannot take the scenes, there is no such setting, or two choices have one name.
    """
    choices: list[Choice] = []
    if scenes.preset is not None:
        choices += _simulator_choices(sweep.simulator, scenes.preset)
    for name, emulator in models.items():
        model = fit_to_scenes(name, emulator, scenes, **match)
        choices += _model_choices(sweep.models, model, scenes, device)
        choices += _ensembles(sweep.models, model, device, (nudges or {}).get(name))
    some_enter = any(recording.present is not None for recording in scenes.recordings)
    bundles = [emulator.frames for emulator in models.values()] if some_enter else []
    predict_by = partial(PredictorChoice, enter_every=max(bundles, default=1))
    for predictor in (make(scenes.scene) for make in predictors):
        settings = {"model": predictor.name}
        choices.append(predict_by(kind=Kind.OTHER, name=predictor.name, settings=settings, predictor=predictor))
    choices += [
        predict_by(kind=Kind.TRIVIAL, name="nothing moves", predictor=still),
        predict_by(kind=Kind.TRIVIAL, name="free fall", predictor=partial(free_fall, scenes.scene)),
    ]
    names = [choice.name for choice in choices]
    if repeated := next((name for name in names if names.count(name) > 1), None):
        raise ConfigError(f"Two choices are called {repeated!r}: leave one out, or give it another name.")
    return choices


def _simulator_choices(settings: SimulatorSettings, preset: Preset) -> Iterator[Choice]:
    """The simulator as shipped, other settings but for those that the preset itself refuses, and the floors."""
    yield _simulator_choice(preset, 1)
    twin = twin_of(preset)
    for factor in sorted({1, *settings.coarser}):
        try:
            coarse = preset.coarsened(factor) if factor > 1 else preset
        except ConfigError:
            continue
        counts = {math.ceil(share * preset.substeps / factor) for share in settings.substeps}
        counts |= (
            {coarse.stable_substeps} if factor > 1 else {coarse.stable_substeps, min(twin.substeps, preset.substeps)}
        )
        for substeps in sorted(counts, reverse=True):
            if (factor, substeps) == (1, preset.substeps):
                continue
            try:
                yield _simulator_choice(dataclasses.replace(coarse, substeps=substeps), factor)
            except ConfigError:  # a wave would skip cells or particles
                continue
    yield _simulator_choice(twin, 1, f"twin: {twin.substeps} of {preset.substeps} substeps")
    if settings.nudge:
        yield _simulator_choice(preset, 1, f"simulator nudged by {settings.nudge:g}", settings.nudge)


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


def _model_choices(settings: ModelSettings, model: FittedModel, scenes: Scenes, device: torch.device) -> list[Choice]:
    """All forms of a model; ConfigError if there is no such runtime.

    Forms that predict the same in the same way, such as those of a model without constraints, are listed once. The
    first of each setting is not part of a form's name.
    """
    facts = _facts(model)
    forms: dict[str, Choice] = {}
    precisions, runtimes = settings.precisions(device), settings.runtimes(device)
    first = precisions[0], settings.constraints[0], runtimes[0]
    for variant in product(precisions, settings.constraints, runtimes):
        precision, constraints, runtime = variant
        form = model.emulator.with_network(NETWORK_PRECISIONS[precision])
        form = (form if constraints == "held" else form.unconstrained()).to(device)
        try:
            form = form.with_runtime(runtime)
        except ConfigError:
            if settings.runtime is not None:
                raise
            continue  # none that was asked for
        name = ", ".join([facts["model"], *(part for part, usual in zip(variant, first, strict=True) if part != usual)])
        varied = {"precision": precision, "constraints": constraints, "runtime": runtime}
        varied["cells"] = "×".join(map(str, form.grid.shape))
        for batch in settings.batch:
            choice = ModelChoice(
                name=name if batch == 1 else f"{name}, batch {batch}",
                emulator=form,
                matched=None if model.reading is None else MatchedPredictor(form, model.reading, scenes.scene),
                settings=facts | varied,
                batch=batch,
                device=device,
            )
            forms.setdefault(digest([dict(choice.identity), batch]), choice)
    return list(forms.values())


def _facts(model: FittedModel) -> dict[str, str]:
    """The settings that all forms of a model have."""
    facts = {"model": model.name + OTHER_SCENES * bool(model.differing), "weights": model.weights}
    return facts | ({"scenes_differ_in": model.differing} if model.differing else {})


def _ensembles(
    settings: ModelSettings, model: FittedModel, device: torch.device, nudge: float | None
) -> Iterator[Choice]:
    """The members of a model's first form; ConfigError for a model that is matched to the scenes."""
    if not settings.members:
        return
    if model.reading is not None:
        raise ConfigError(
            f"--members: {model.name} was trained on scenes of another kind, and only its one rollout is matched to"
            " these: leave --members or this model out."
        )
    form = model.emulator.with_network(NETWORK_PRECISIONS[settings.precisions(device)[0]])
    form = form if settings.constraints[0] == "held" else form.unconstrained()
    facts, size = _facts(model), nudge_of(form, nudge)
    yield MembersChoice(
        name=f"{facts['model']}, {counted(settings.members, 'member')}",
        emulator=form.to(device).with_runtime(settings.runtimes(device)[0]),
        members=settings.members,
        nudge=size,
        settings=facts | {"nudge": size},
        device=device,
    )
