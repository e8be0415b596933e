"""`nmpm stress`: a model at the extremes; `nmpm trade` and `nmpm compare`: beside the simulator and other models."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from nmpm._support.messages import counted
from nmpm.cli.command import UsageError, option, positional
from nmpm.cli.options import (
    AtLeast,
    Data,
    DeviceOptions,
    ExistingFile,
    FactOptions,
    MatchOptions,
    ModelOptions,
    OutputFolder,
    Positive,
    PresetName,
    RuntimeOptions,
    StrictReadingOptions,
    Style,
    ThreadsOptions,
    check_folder,
    check_model,
    choose_threads,
    describe,
)
from nmpm.errors import ConfigError
from nmpm.evaluation.stress import GROUPS

if TYPE_CHECKING:
    from nmpm.evaluation.stress.model import ModelUnderTest
    from nmpm.evaluation.stress.results import TestResult
    from nmpm.zoo import Pretrained


def _check_groups(option: str, names: list[str]) -> None:
    if unknown := sorted(set(names) - set(GROUPS)):
        raise ConfigError(f"{option} {' '.join(unknown)}: the groups are {', '.join(GROUPS)}.")


@dataclass(frozen=True, kw_only=True)
class Stress(ModelOptions, DeviceOptions, ThreadsOptions, RuntimeOptions, StrictReadingOptions):
    """Test a model at the extremes: pass or fail, with measured margins.

    The tests are long rollouts, settling, fast and slow, many and few particles, other boxes and grids, precision,
    sensitivity, obstacles that training never showed, non-finite input. A line of each says pass or fail by a stated
    invariant, with what was measured. Errors are against the simulator that made the training data, where there is one.
    Exits with 1 if a line fails.

    Args:
        full: Longer and larger: tens of minutes (default: minutes, as zoo cards quote).
        preset: Simulator of the scenes (default: of the training data; none if recorded); scenes of another kind than
            the model's are matched to it, as by nmpm rollout.
        free: Without the model's constraints: the network alone.
        groups: Only these, of {groups} (default: all).
        seed: Of the scenes (default: 0).
        json: Print JSON, and no table.
        report: Write stress.json, stress.md and stress.png there; stress_free.* with --free.

    Examples:
        nmpm stress goop                          all tests, in minutes
        nmpm stress goop --groups long settling   some of them
        nmpm stress runs/goop --free              a run's best checkpoint, without constraints
        nmpm stress goop --full --report stress   longer and larger, with a table and a picture
        nmpm stress multimaterial --preset sandramps   on another simulator's scenes
    """

    full: bool = False
    preset: PresetName | None = None
    free: bool = False
    groups: Annotated[list[str], _check_groups] | None = option(metavar="GROUP")
    seed: int = 0
    json: bool = False
    report: OutputFolder | None = option(metavar="DIR")

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        return {**super().help_values(), "groups": ", ".join(GROUPS)}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.match != MatchOptions() and not self.preset:
            raise ConfigError("--materials, --stride and --strict are about the scenes of a --preset: give it too.")

    def run(self) -> int:
        from rich.console import Console

        from nmpm._support.progress import progress_bar
        from nmpm.evaluation.stress.model import battery
        from nmpm.evaluation.stress.results import FULL, QUICK, as_json, summary, table, write

        model, start = self._model_under_test(), time.monotonic()
        results: list[TestResult] = []
        groups = self.groups or list(GROUPS)
        with progress_bar("stress", len(groups)) as step:
            for name in groups:
                step(f"stress, {name}", by=0)
                results += battery(model, FULL if self.full else QUICK, [name])
                step()
        seconds, size = time.monotonic() - start, "full" if self.full else "quick"
        text = as_json(model.name, size, seconds, results)
        if self.json:
            sys.stdout.write(text + "\n")
        else:
            console = Console()
            console.print(table(f"{model.name}, {size}, {seconds:.0f} s", results))
            console.print(summary(results))
        if self.report is not None:
            paths = write(self.report, text, results, "stress_free" if self.free else "stress")
            sys.stderr.write(f"wrote {', '.join(map(str, paths))}\n")
        return int(any(result.passed is False for result in results))

    def _model_under_test(self) -> ModelUnderTest:
        """The model; on a preset's scenes, what matches them, where they are of another kind, is printed."""
        from nmpm.emulator.similarity import find_match
        from nmpm.evaluation.stress.model import ModelUnderTest
        from nmpm.scene import Motion
        from nmpm.sim import load_preset
        from nmpm.zoo import load_model
        from nmpm.zoo.measures.scenes import simulator_of

        model = load_model(self.model, self.device, self.root).optimized(self.runtime)
        choose_threads(model, self.threads)
        if "open" in model.scene.boundary:
            raise ConfigError(
                f"{self.model}: these tests are of closed boxes, and the model's scenes have open axes."
                " `nmpm compare` and `nmpm rollout --data` measure it on recordings."
            )
        emulator = model.emulator.unconstrained() if self.free else model.emulator
        tested = ModelUnderTest(self.model, emulator, model.horizon, simulator_of(model), self.seed)
        if self.preset is None:
            return tested
        preset = load_preset(self.preset)
        match = find_match(emulator, preset.scene, Motion(), *self.match, names=(self.model, preset.name))
        tested = tested.over(preset, match)
        if tested.reading is not None:
            (sys.stderr if self.json else sys.stdout).write(describe(match, self.model))
        return tested


@dataclass(frozen=True, kw_only=True)
class _Sweep(DeviceOptions, StrictReadingOptions, FactOptions):
    """Choices that are measured on test scenes.

    Args:
        scenes: Number of test scenes (default: {scenes}).
        wider: Simulate scenes of a domain so many times as wide, with more blocks.
        out: Folder to write to (default: {command}/DATASET).
        style: Also the chart of time and error for slides (SVG) or for print (PDF).
    """

    title: ClassVar[str] = "scenes and report"
    command: ClassVar[str]
    default_scenes: ClassVar[int]
    scenes: Positive | None = None
    wider: Annotated[int, AtLeast(2)] | None = option(metavar="TIMES")
    out: Path | None = option(metavar="DIR")
    style: Style | None = None

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        return {"command": cls.command, "scenes": str(cls.default_scenes)}

    def measure(
        self, dataset: str, models: list[str] | None, predictors: list[str], members: int | None, config: Path | None,
        times: bool,
    ) -> None:  # fmt: skip
        """Measure the sweep of the command on a dataset, print the table, and write the report.

        Args:
            dataset: Name, or path.
            models: Names; those of the dataset if None.
            predictors: Of other packages.
            members: Of an ensemble of each model.
            config: YAML of the sweep, in place of the command's own.
            times: Whether to measure times of recorded data, too.
        """
        for name in models or ():
            check_model(name)
        if self.wider and (stated := self.arguments):
            raise ConfigError(f"{stated[0]}: --wider simulates scenes, and their facts are known: leave it out.")
        wider = f"-{self.wider}-times-as-wide" if self.wider else ""
        out = self.out or Path(self.command) / f"{Path(dataset).name}{wider}"
        check_folder("--out", out)
        from rich.console import Console

        from nmpm._support.bounded_files import read_text
        from nmpm._support.machine import find_device
        from nmpm.evaluation import trade
        from nmpm.evaluation.trade.report import likely_points, report_lines, summary_table, write_report
        from nmpm.viz.output import STYLES
        from nmpm.zoo.registry import load_models, load_models_of

        text = trade.shipped_sweep_text(self.command) if config is None else read_text(config)
        sweep = trade.read_sweep(text, f"the sweep of nmpm {self.command}" if config is None else str(config))
        sweep = sweep if self.scenes is None else sweep.with_scenes(self.scenes)
        sweep = sweep if members is None else sweep.with_members(members)
        factories = [trade.find_factory(path) for path in predictors]
        if models is None:
            loaded, damaged = load_models_of(Path(dataset).name)
            sys.stderr.writelines(f"left out: {error}\n" for error in damaged)
        else:
            loaded = load_models(models)
        if self.wider:
            scenes = trade.find_wider_scenes(dataset, sweep.scenes, self.wider)
        else:
            scenes = trade.find_scenes(dataset, sweep.scenes, self.facts)
        self._check_materials(loaded)
        device = find_device(self.device)
        emulators = {name: model.emulator for name, model in loaded.items()}
        nudges = {name: model.nudge for name, model in loaded.items()}
        choices = trade.make_choices(sweep, scenes, emulators, device, factories, nudges, **self.match._asdict())
        if not choices:
            raise ConfigError("There is nothing to measure: give --models, or settings of the simulator.")
        for line in sweep.models.left_out(device) if loaded else []:
            sys.stdout.write(f"{line}\n")
        store, left = trade.Store(out), (0, 0.0)
        try:
            if scenes.preset is None and not (times or config or members):
                points, left = trade.measure_errors_first(choices, scenes, sweep, store, self.command)
            else:
                points = trade.measure(choices, scenes, sweep, store, self.command)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted; what is measured is in {out}, and the same command goes on."
            ) from None
        console = Console()
        shown = likely_points(points) if self.command == "trade" and not left[0] else points
        console.print(summary_table(shown, points, scenes))
        for line in report_lines(points):
            console.print(line, highlight=False, soft_wrap=True)
        paths = write_report(out, self.command, points, scenes, self.style and STYLES[self.style])
        sys.stderr.write(f"wrote {', '.join(map(str, paths))}\n")
        if left[0]:
            sys.stdout.write(
                f"next: times, and the models in other forms: {counted(left[0], 'measurement')}, about"
                f" {timedelta(seconds=max(1, round(left[1])))}\n"
                f"  {shlex.join(['nmpm', self.command, *self.words, '--times'])}\n"
            )

    def _check_materials(self, models: Mapping[str, Pretrained]) -> None:
        """Raise ConfigError if no model has the materials that an option names; those that have are matched by them."""
        named = set((self.match.materials or {}).values())
        if models and not any(named <= set(model.scene.materials) for model in models.values()):
            known = sorted({name for model in models.values() for name in model.scene.materials})
            raise ConfigError(f"--materials: no model has {', '.join(sorted(named))}; they have {', '.join(known)}.")


@dataclass(frozen=True, kw_only=True)
class Trade(_Sweep):
    """Measure time and errors of models, the simulator and trivial predictors.

    The trade between speed and accuracy: time and errors of emulators, of the simulator with fewer substeps and on
    coarser grids, and of trivial predictors, on the same test scenes and machine. Answers what to run for a budget of
    milliseconds per frame, be it an emulator or not.

    Args:
        dataset: An embedded dataset (goop, …), or a file or folder of data.
        models: A model of the zoo (see nmpm zoo list); a path: a run, a checkpoint, or an entry's folder; or an id of
            the Hugging Face hub, owner/repository@revision (default: the zoo's of this dataset).
        predictors: Predictors of other packages: the module is imported, and its code runs.
        config: YAML of what is measured, see --print_config.
        times: Of recorded data, whose errors alone are measured first: times, too, and all forms of the models.
        print_config: Print the shipped sweep, and stop.
        members: Also an ensemble of M rollouts of each model, and everybody's CRPS.

    Examples:
        nmpm trade goop                               the zoo's models of goop beside its simulator
        nmpm trade goop --models goop runs/a runs/b   models of your own beside it
        nmpm trade goop --predictors mine:make        a predictor of another package: make(scene) gives it
        nmpm trade waterramps --members 8             ensembles of the models, judged by their fair CRPS
        nmpm trade FOLDER --models runs/mine          recorded data: errors, and how long the rest takes
        nmpm trade FOLDER --models runs/mine --times  ... and the rest: times, precisions, batches
        nmpm trade --print_config > sweep.yaml        what is measured; edit it, then:
        nmpm trade goop --config sweep.yaml

        It writes to the folder of --out: trade.csv (one row for each choice and error), trade.md (the table),
        trade.json (all figures of every scene), trade.png (error against time), errors.png (error against frames),
        frames.png (the first scene, side by side), and points/, which holds every measurement: the same command goes on
        after an interruption, and measures only what is new. Times of one CPU thread are CPU time, and all choices take
        turns; other load on the machine still slows networks more than the simulator, so measure on an idle one. Delete
        points/times-* to time everything anew.
    """

    command: ClassVar[str] = "trade"
    default_scenes: ClassVar[int] = 20
    dataset: Data | None = positional()
    models: list[str] | None = option(metavar="MODEL", nargs="*")
    predictors: list[str] | None = option(metavar="MODULE:FACTORY[:ARGUMENT]", nargs="*")
    config: ExistingFile | None = option(metavar="FILE")
    times: bool = False
    print_config: bool = False
    members: Positive | None = option(metavar="M")

    def run(self) -> None:
        if self.print_config:
            from nmpm.evaluation.trade import shipped_sweep_text

            sys.stdout.write(shipped_sweep_text("trade"))
            return
        if self.dataset is None:
            raise ConfigError("name a dataset, such as goop, or the folder of one; see nmpm trade --help.")
        self.measure(str(self.dataset), self.models, self.predictors or [], self.members, self.config, self.times)


@dataclass(frozen=True, kw_only=True)
class Compare(_Sweep):
    """Compare models on scenes that need not be their own.

    The test scenes may have other particle counts, other obstacles, a wider domain, other units. A model of other
    scenes keeps its weights, and gets a grid over their domain on which they are, in cells and frames, like those of
    its training. Beside the models stand trivial predictors and, for simulated scenes, the simulator's time and what
    its own results are uncertain by.

    Args:
        models: A model of the zoo (see nmpm zoo list); a path: a run, a checkpoint, or an entry's folder; or an id of
            the Hugging Face hub, owner/repository@revision.
        data: An embedded dataset (goop, …), or a file or folder of data.

    Examples:
        nmpm compare waterramps waterdrop --data waterdrop-xl   for four times as many particles?
        nmpm compare waterramps --data waterramps --wider 2     ... in a domain twice as wide?
        nmpm compare goop runs/mine --data goop --scenes 30     your own model beside the zoo's
        nmpm compare sandramps multimaterial --data FOLDER --materials big=sand,small=sand
                                                                on recorded data of any form

        It prints a table, and writes to the folder of --out the files of nmpm trade: compare.csv, compare.md,
        compare.json (all figures, of every scene), compare.png (error against time), errors.png (error against frames),
        frames.png (the first scene's splash and last frame, side by side), and points/, which holds every measurement:
        with one more model, the same command measures only what is new. Scenes of another gravity, time between frames
        or material are matched: a model takes them in cells and at a stride that make them like its own, which a line
        below the table states. --strict refuses what cannot be matched.
    """

    command: ClassVar[str] = "compare"
    default_scenes: ClassVar[int] = 6
    models: list[str]
    data: Data | None = option(metavar="DATASET")

    def __post_init__(self) -> None:
        if self.data is None:
            raise UsageError("the following arguments are required: --data. See nmpm compare --help.")
        super().__post_init__()

    def run(self) -> None:
        self.measure(str(self.data), self.models, [], None, None, times=True)
