"""`nmpm rollout MODEL --frames 400 --out out.h5`."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from nmpm.cli.command import option
from nmpm.cli.options import (
    Data,
    DeviceOptions,
    FactOptions,
    MatchOptions,
    ModelOptions,
    Natural,
    Positive,
    RuntimeOptions,
    SplitName,
    StrictReadingOptions,
    ThreadsOptions,
    TrajectoryFile,
    choose_threads,
    describe,
)
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.format import Trajectory
    from nmpm.emulator import Rollout
    from nmpm.particles import Window
    from nmpm.zoo import Pretrained
    from nmpm.zoo.starts import Start

FRAMES = 400
"""Predicted without a recording, unless an option says otherwise."""


def _check_nudge(option: str, cells: float) -> None:
    if not 0 <= cells < math.inf:
        raise ConfigError(f"{option} {cells}: it must be a number of cells, 0 or more, such as 0.1.")


@dataclass(frozen=True, kw_only=True)
class RollOut(ModelOptions, DeviceOptions, ThreadsOptions, RuntimeOptions, StrictReadingOptions, FactOptions):
    """Roll a pretrained model out and write the trajectories.

    It starts in a scene as those of the model's training, from thrown blocks of particles, or from a recorded
    trajectory.

    Args:
        frames: Frames to predict (default: 400; with --data, the recording's).
        out: File to write, by its suffix: {suffixes}.
        data: Start from a trajectory of this file or folder, of any format that nmpm inspect reads, or of an embedded
            dataset (goop, …); write it beside the prediction, and print the error.
        split: Of --data, if it has several (default: test).
        trajectory: Index in --data (default: 0, the first).
        seed: Of the scene, and of members (default: 0).
        members: Rollouts from the same start, by a model's own noise or from nudged positions; a trajectory each, in
            one .h5 or .vtkhdf, or in out-0.csv, out-1.csv, ….
        nudge: Standard deviation of the displacements of members' starts (default: the model's, see nmpm zoo card).
        until: End with the last frame that is trusted, see the how-to.
        particles: Throw blocks of about so many in all (with --blocks: 1000).
        blocks: Throw so many blocks (with --particles: one of each material).
        precision: Of the network: float32 (default), or bfloat16, less accurate, faster if the processor supports it.
        watch: If speed, energy or crowding exceed the model's known range: warn (default), stop, or only record.

    Examples:
        nmpm rollout waterramps --frames 400 --out out.h5      a zoo model, in a scene of its simulator
        nmpm rollout waterramps --blocks 3 --seed 1            from thrown blocks
        nmpm rollout waterramps --data waterramps              from a test scene, beside the simulation
        nmpm rollout runs/goop --data test.h5 --trajectory 3   a run's best, from a recorded start
        nmpm rollout runs/grains --data grains.npz             or from any other form of data
        nmpm rollout sandramps --data grains --materials big=sand,small=sand
                                                               or from data of another kind
        nmpm rollout runs/mixer --data mixer.npz --types 0=dough,1=blade --prescribed 1
                                                               with facts that the files lack
        nmpm rollout wbcsph --gravity 6,7.5                    thrown blocks, with gravity to one side
        nmpm rollout runs/goop/checkpoints/last.ckpt
        nmpm rollout goop --out splash.usda                    for Blender; .vtkhdf for ParaView, .csv, …
        nmpm rollout goop --device cuda                        on a GPU, by CUDA graphs
        nmpm rollout waterramps --until trusted                as far as it predicts this scene
        nmpm rollout waterramps --members 8                    eight futures of one start
    """

    frames: Positive | None = None
    out: TrajectoryFile = Path("out.h5")
    data: Data | None = None
    split: SplitName | None = None
    trajectory: Natural = 0
    seed: Natural = 0
    members: Positive | None = option(metavar="M")
    nudge: Annotated[float, _check_nudge] | None = option(metavar="CELLS")
    until: Literal["trusted"] | None = None
    particles: Positive | None = None
    blocks: Positive | None = None
    precision: Literal["float32", "bfloat16"] = "float32"
    watch: Literal["warn", "stop", "record"] = "warn"

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        from nmpm.data.write import suffixes

        return {**super().help_values(), "suffixes": suffixes()}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.data is None and self.match != MatchOptions():
            raise ConfigError("--materials, --stride and --strict are about recorded data: give --data too.")
        facts = [fact for fact in self.arguments if not fact.startswith("--gravity")]
        if self.data is None and facts:
            raise ConfigError(f"{facts[0]} is about recorded data: give --data too.")
        if self.members is not None and self.until:
            raise ConfigError("--until is about one rollout: leave --members out.")
        if self.nudge is not None and self.members is None:
            raise ConfigError(f"--nudge {self.nudge} displaces the starts of members: give --members too.")
        from nmpm.data.write import find_writer

        for path in find_writer("--out", self.out).paths(self.out, self.members or 0):
            find_writer("--out", path)

    def run(self) -> None:
        from nmpm.zoo.registry import load_model

        model = load_model(self.model, self.device, self.root)
        start = _start_of(model, self)
        model = start.model.optimized(self.runtime, self.precision, start.state)
        choose_threads(model, self.threads)
        sys.stdout.write(f"to look at them: {_roll_out(dataclasses.replace(start, model=model), self)}\n")


def _start_of(model: Pretrained, options: RollOut) -> Start:
    """A scene of the model's training, thrown blocks, or a recorded trajectory, as the options say; it is printed."""
    from nmpm.zoo.starts import recorded_start

    if options.data is None:
        return _scene_start(model, options)
    start = recorded_start(model, options.data, options.split, options.trajectory, options.facts, *options.match)
    if start.model.match is not None:
        sys.stdout.write(describe(start.model.match, model.name))
    return start


def _scene_start(model: Pretrained, options: RollOut) -> Start:
    """A scene of the model's training, or thrown blocks; what it is is printed."""
    from nmpm.zoo.scenes import training_preset
    from nmpm.zoo.starts import Start
    from nmpm.zoo.states import THROWN

    gravity, preset = options.facts.gravity, training_preset(model.scene, model.preset)
    if options.particles is None and options.blocks is None and preset is not None:
        state = model.example(options.seed, gravity=gravity)
        solid = ", with obstacles" if state.obstacle.shape[1] else ""
        count = state.position.shape[1]
        sys.stdout.write(f"Scene of {preset.name}, seed {options.seed}: {count:,} particles{solid}.\n")
        return Start(model, model.scene, state, state)
    if options.particles is None and options.blocks is None:
        sys.stdout.write(
            f"No preset has the scenes that {options.model} was trained on: about {THROWN:,} particles are thrown into"
            " its box. --data starts from a recorded scene.\n"
        )
    count = THROWN if options.particles is None else options.particles
    try:
        state = model.example(options.seed, count, options.blocks, gravity)
    except ConfigError as error:
        blocks = "" if options.blocks is None else f" --blocks {options.blocks}"
        raise ConfigError(f"--particles {count}{blocks}: {error}") from error
    return Start(model, model.scene, state, state)


def _roll_out(start: Start, options: RollOut) -> str:
    """Predict, write and compare with what was recorded, as the options say; how to look at the files."""
    from nmpm.data.write import find_writer

    frames = options.frames or (FRAMES if start.recorded is None else start.recorded.target.shape[1])
    if options.members is not None:
        files = _roll_out_members(start, frames, options.members, options)
    else:
        rollout = (_predict_trusted if options.until else _predict)(start, frames, options)
        files = _write(iter([start.trajectory(options.model, rollout)]), options)
        if start.recorded is not None:
            _print_errors(start, start.recorded, rollout, start.errors(start.recorded, [rollout]))
    return find_writer("--out", options.out).hint(files[0])


def _predict(start: Start, frames: int, options: RollOut) -> Rollout:
    """So many frames; what was watched and the time of a frame are printed."""
    from nmpm._support.machine import device_name
    from nmpm.emulator.monitor import Monitor, Policy

    monitor = Monitor(Policy(options.watch))
    rollout, taken = start.predict(frames, monitor)
    device = device_name(start.model.emulator.device)
    sys.stdout.write(f"{monitor.report()}\n{taken:.3g} ms per frame on {device}.\n")
    return rollout


def _predict_trusted(start: Start, frames: int, options: RollOut) -> Rollout:
    """The frames that are trusted, of so many at most; what was watched is printed.

    Raises:
        ConfigError: if no frame is trusted.
    """
    from nmpm.emulator import Rollout, RolloutOptions, stream_rollout
    from nmpm.emulator.monitor import Monitor, Policy
    from nmpm.emulator.trust import TrustTracker

    state, prescribed = start.on_device()
    emulator, monitor = start.model.emulator, Monitor(Policy(options.watch))
    tracker = TrustTracker(emulator.scene, state, start.model.trust)
    given = RolloutOptions(prescribed, monitor=monitor, tracker=tracker, until_trusted=True)
    stream = stream_rollout(emulator, state, frames * start.between, given)
    trusted = Rollout.join(list(start.timed_parts(stream, frames, [])))
    sys.stdout.write(f"{monitor.report()}\n")
    if not trusted.position.shape[1]:
        raise ConfigError(f"--until trusted: no frame is. {tracker.report()} Without it, all are written.")
    return trusted


def _roll_out_members(start: Start, frames: int, members: int, options: RollOut) -> list[Path]:
    """Predict and write members; print their mean error beside that of one rollout without noise and nudge."""
    from nmpm.data.format import MEMBER
    from nmpm.emulator import RolloutOptions, stream_rollout
    from nmpm.emulator.members import member_starts
    from nmpm.emulator.monitor import Monitor, Policy
    from nmpm.emulator.trust import TrustTracker
    from nmpm.evaluation.figures import PREDICTORS
    from nmpm.zoo.starts import MemberFrames, milliseconds

    single = None if start.recorded is None else _predict(start, frames, options)
    model, seed = start.model, options.seed
    emulator, nudge = model.emulator, model.nudge if options.nudge is None else options.nudge
    with MemberFrames(options.out.parent) as stored:
        state, prescribed = start.on_device()
        tracker, monitor = TrustTracker(emulator.scene, state, model.trust), Monitor(Policy(options.watch))
        given = RolloutOptions(prescribed, None, monitor, members, seed, nudge, tracker)
        stream = stream_rollout(emulator, state, frames * start.between, given)
        times: list[float] = []
        for part in start.timed_parts(stream, frames, times, f"{members} members"):
            stored.add(part)
        cost = milliseconds(times, emulator.frames / start.between * members)
        sys.stdout.write(f"{members} members, {cost:.3g} ms per frame and member: {monitor.report()}\n")
        starts = member_starts(emulator, state, members, seed, nudge).to("cpu")

        def trajectory(member: int) -> Trajectory:
            moved = start.written.with_motion(starts.position[[member]], start.written.velocity)
            made = start.trajectory(options.model, stored.member(member), moved)
            return dataclasses.replace(made, attributes=made.attributes | {MEMBER: member})

        files = _write(map(trajectory, range(members)), options)
        if start.recorded is not None and single is not None:
            figures = start.errors(start.recorded, map(stored.member, range(members)))
            one = start.errors(start.recorded, [single])
            figures |= {f"single/{name}": value for name, value in one.items() if "/" not in name}
            names = {"model": f"a member, mean of {members}", "single": "without noise and nudge"}
            _print_errors(start, start.recorded, single, figures, {**names, **PREDICTORS, **names})
    return files


def _write(trajectories: Iterator[Trajectory], options: RollOut) -> list[Path]:
    """Write a prediction, or those of members, and print what the files hold."""
    from nmpm.data.format import TRUTH
    from nmpm.data.predictions import read_description
    from nmpm.data.write import write_trajectories, write_trajectory

    first, out, members = next(trajectories), options.out, options.members
    _, metadata = read_description(first.attributes, out, len(first.position))
    particles = int(metadata.is_moving(first.particle_type).sum())
    what = f"2 frames of the start and {len(first.position) - 2} predicted, of {particles} particles"
    if members is None:
        files = [write_trajectory(out, first, metadata)]
        what += ", beside the recording" if TRUTH in first.fields else ""
    else:
        files = write_trajectories(out, chain([first], trajectories), metadata, members * len(first.position))
        what = f"{members} members of {what}"
    sys.stdout.write(f"wrote {what}, to {files[0]}{f' … {files[-1]}' if len(files) > 1 else ''}\n")
    return files


def _print_errors(
    start: Start, recorded: Window, shown: Rollout, figures: Mapping[str, float], names: Mapping[str, str] | None = None
) -> None:
    """Print a table of errors over the frames of a rollout that were recorded."""
    from rich.console import Console

    from nmpm.evaluation.figures import PREDICTORS, error_table

    frames = min(recorded.target.shape[1], shown.position.shape[1])
    Console().print(error_table(f"{start.source}, {frames} frames:", figures, names or PREDICTORS))
