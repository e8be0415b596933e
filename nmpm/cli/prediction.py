"""The rollouts of `nmpm rollout`: what they start from, what is printed of them, and the files."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path

from rich.console import Console

from nmpm._support.machine import device_name
from nmpm.cli.options import describe
from nmpm.cli.rollout import RollOut
from nmpm.data.format import MEMBER, TRUTH, Trajectory
from nmpm.data.predictions import read_description
from nmpm.data.write import find_writer, write_trajectories, write_trajectory
from nmpm.emulator import Rollout, RolloutOptions, stream_rollout
from nmpm.emulator.members import member_starts
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.emulator.trust import TrustTracker
from nmpm.errors import ConfigError
from nmpm.evaluation.figures import PREDICTORS, error_table
from nmpm.particles import Window
from nmpm.zoo import Pretrained
from nmpm.zoo.scenes import training_preset
from nmpm.zoo.starts import MemberFrames, Start, milliseconds, recorded_start
from nmpm.zoo.states import THROWN

FRAMES = 400
"""Predicted without a recording, unless an option says otherwise."""


def start_of(model: Pretrained, options: RollOut) -> Start:
    """A scene of the model's training, thrown blocks, or a recorded trajectory, as the options say; it is printed."""
    if options.data is None:
        return _scene_start(model, options)
    start = recorded_start(model, options.data, options.split, options.trajectory, options.facts, *options.match)
    if start.model.match is not None:
        sys.stdout.write(describe(start.model.match, model.name))
    return start


def _scene_start(model: Pretrained, options: RollOut) -> Start:
    """A scene of the model's training, or thrown blocks; what it is is printed."""
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


def roll_out(start: Start, options: RollOut) -> str:
    """Predict, write and compare with what was recorded, as the options say; how to look at the files."""
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
    start: Start, recorded: Window, shown: Rollout, figures: Mapping[str, float], names: Mapping[str, str] = PREDICTORS
) -> None:
    """Print a table of errors over the frames of a rollout that were recorded."""
    frames = min(recorded.target.shape[1], shown.position.shape[1])
    Console().print(error_table(f"{start.source}, {frames} frames:", figures, names))
