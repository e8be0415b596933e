"""`nmpm rollout MODEL --frames 400 --out out.h5`."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.shipped import find_preset
from nmpm.cli.match_options import MatchOptions, add_match_options
from nmpm.cli.options import (
    CommandParser,
    add_data_options,
    add_device_option,
    add_model_options,
    add_out_option,
    add_runtime_option,
    add_split_option,
    add_threads_option,
    check_at_least,
    check_data,
    check_device,
    check_model,
    check_runtime,
    choose_threads,
    data_options,
    find_data,
    gravity_option,
    stated_facts,
)
from nmpm.data.write import find_writer
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.emulator import Prescribed, Rollout
    from nmpm.particles import Particles
    from nmpm.zoo import Pretrained

FRAMES = 400
"""Predicted without a recording, unless an option says otherwise."""

_EXAMPLES = """\
examples:
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
  nmpm rollout waterramps --fallback waterramps          and on from there by the simulator
  nmpm rollout waterramps --members 8                    eight futures of one start
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["rollout", "goop", "--frames", "400", "--out", "out.h5"]."""
    options = _parser().parse_args(words[1:])
    _check(options)
    from nmpm.zoo.registry import load_model

    model = load_model(options.model, options.device, options.root)
    hint = _from_scene(model, options) if options.data is None else _from_recording(model, options)
    sys.stdout.write(f"to look at them: {hint}\n")


def _from_scene(model: Pretrained, options: argparse.Namespace) -> str:
    """Roll out from a scene of the model's training, or from thrown blocks; return how to look at what is written."""
    from nmpm.cli.prediction import predicted, write_prediction

    model = _optimized(model, options)
    state, frames = _start_state(model, options), options.frames or FRAMES
    if options.members is not None:
        from nmpm.cli.member_rollouts import MemberRollouts

        return MemberRollouts(model, model.scene, state, state, frames, options).run()
    rollout = _predict(model, state, frames, options)
    return write_prediction(options.out, predicted(model, options.model, model.scene, state, rollout))


def _from_recording(model: Pretrained, options: argparse.Namespace) -> str:
    """Roll out from a recorded trajectory and print the errors; return how to look at what is written."""
    from rich.console import Console

    from nmpm.cli.member_rollouts import MemberRollouts
    from nmpm.cli.prediction import predicted, write_prediction
    from nmpm.cli.recorded_start import RecordedStart, compared, recorded_errors
    from nmpm.emulator import Prescribed
    from nmpm.evaluation.figures import error_table

    options.data = find_data(options.data, options.split, options.trajectory)
    start = RecordedStart.of(model, options)
    model, written = _optimized(start.model, options), start.written
    recorded = written.target.shape[1]
    frames = options.frames or recorded or FRAMES
    prescribed, window = Prescribed.of(start.window), written if recorded else None
    state = start.window.initial
    if options.members is not None:
        members = MemberRollouts(
            model, start.scene, state, written.initial, frames, options, start.between, prescribed, window, start
        )
        single = _predict(model, state, frames, options, prescribed, start.between) if recorded else None
        return members.run(single)
    rollout = _predict(model, state, frames, options, prescribed, start.between)
    trajectory = predicted(model, options.model, start.scene, written.initial, rollout, window)
    hint = write_prediction(options.out, start.as_recorded(trajectory))
    if recorded:
        bundle, what = max(1, model.emulator.frames // start.between), compared(written, rollout, options)
        Console().print(error_table(what, recorded_errors(start.scene, bundle, written, [rollout])))
    return hint


def _predict(
    model: Pretrained,
    state: Particles,
    frames: int,
    options: argparse.Namespace,
    prescribed: Prescribed | None = None,
    between: int = 1,
) -> Rollout:
    """So many frames, or as many as are trusted."""
    if options.until or options.fallback:
        from nmpm.cli.trusted_rollout import predict_trusted

        return predict_trusted(model, state, prescribed, frames, options, between)
    from nmpm.cli.prediction import predict

    return predict(model, state, frames, options.watch, prescribed, between)


def _start_state(model: Pretrained, options: argparse.Namespace) -> Particles:
    """A scene of the model's training, or thrown blocks; what it is is printed."""
    from nmpm.zoo.scenes import training_preset
    from nmpm.zoo.starts import THROWN

    gravity, preset = gravity_option(options.gravity), training_preset(model)
    thrown = options.particles is not None or options.blocks is not None
    if not thrown and preset is not None:
        state = model.example(options.seed, gravity=gravity)
        solid = ", with obstacles" if state.obstacle.shape[1] else ""
        count = state.position.shape[1]
        sys.stdout.write(f"Scene of {preset.name}, seed {options.seed}: {count:,} particles{solid}.\n")
        return state
    if not thrown:
        sys.stdout.write(
            f"No preset has the scenes that {options.model} was trained on: about {THROWN:,} particles are thrown into"
            " its box. --data starts from a recorded scene.\n"
        )
    count = THROWN if options.particles is None else options.particles
    try:
        return model.example(options.seed, count, options.blocks, gravity)
    except ConfigError as error:
        blocks = "" if options.blocks is None else f" --blocks {options.blocks}"
        raise ConfigError(f"--particles {count}{blocks}: {error}") from error


def _optimized(model: Pretrained, options: argparse.Namespace) -> Pretrained:
    model = model.optimized(options.runtime, options.precision)
    choose_threads(model, options.threads)
    return model


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="nmpm rollout",
        description="Roll a trained model out: in a scene as those of its training, from thrown blocks of particles, or"
        " from a recorded trajectory.",
        epilog=_EXAMPLES,
    )
    add_model_options(parser)
    add_device_option(parser)
    add_threads_option(parser)
    parser.add_argument("--frames", type=int, help="frames to predict (default: 400; with --data, the recording's)")
    add_out_option(parser, Path("out.h5"))
    parser.add_argument(
        "--data",
        type=Path,
        help="start from a trajectory of this file or folder, of any format that nmpm inspect reads, or of an embedded"
        " dataset (goop, …); write it beside the prediction, and print the error",
    )
    add_split_option(parser, "--data")
    add_match_options(parser)
    add_data_options(parser)
    parser.add_argument("--trajectory", type=int, default=0, help="index in --data (default: 0, the first)")
    parser.add_argument("--seed", type=int, default=0, help="of the scene, and of members (default: 0)")
    parser.add_argument(
        "--members",
        type=int,
        metavar="M",
        help="rollouts from the same start, by a model's own noise or from nudged positions; a trajectory each, in one"
        " .h5 or .vtkhdf, or in out-0.csv, out-1.csv, …",
    )
    parser.add_argument(
        "--nudge",
        type=float,
        metavar="CELLS",
        help="standard deviation of the displacements of members' starts (default: the model's, see nmpm zoo card)",
    )
    parser.add_argument("--until", choices=["trusted"], help="end with the last frame that is trusted, see the how-to")
    parser.add_argument(
        "--fallback", metavar="PRESET", help="simulate the frames after the last trusted one, see nmpm simulate --list"
    )
    parser.add_argument("--particles", type=int, help="throw blocks of about so many in all (with --blocks: 1000)")
    parser.add_argument("--blocks", type=int, help="throw so many blocks (with --particles: one of each material)")
    parser.add_argument(
        "--precision",
        choices=["float32", "bfloat16"],
        default="float32",
        help="of the network: float32 (default), or bfloat16, less accurate, faster if the processor supports it",
    )
    add_runtime_option(parser)
    parser.add_argument(
        "--watch",
        choices=["warn", "stop", "record"],
        default="warn",
        help="if speed, energy or crowding exceed the model's known range: warn (default), stop, or only record",
    )
    return parser


def _check(options: argparse.Namespace) -> None:
    """Check the numbers and paths before anything is loaded."""
    for name, least in (("frames", 1), ("threads", 1), ("particles", 1), ("blocks", 1), ("seed", 0), ("trajectory", 0)):
        check_at_least(f"--{name}", getattr(options, name), least)
    if options.fallback is not None:
        find_preset(options.fallback)
    check_model(options.model, options.root)
    check_device(options.device)
    check_runtime(options.runtime)
    match = MatchOptions.read(options.materials, options.stride, options.strict)
    data_options(options)
    if options.data is not None:
        check_data("--data", options.data)
    elif match != MatchOptions():
        raise ConfigError("--materials, --stride and --strict are about recorded data: give --data too.")
    elif facts := [fact for fact in stated_facts(options) if not fact.startswith("--gravity")]:
        raise ConfigError(f"{facts[0]} is about recorded data: give --data too.")
    _check_members(options)


def _check_members(options: argparse.Namespace) -> None:
    """Check the numbers of members, and that all files can be written."""
    check_at_least("--members", options.members, 1)
    if options.members is not None and (options.until or options.fallback):
        raise ConfigError("--until and --fallback are about one rollout: leave --members out.")
    if options.nudge is not None and options.members is None:
        raise ConfigError(f"--nudge {options.nudge} displaces the starts of members: give --members too.")
    if options.nudge is not None and not 0 <= options.nudge < math.inf:
        raise ConfigError(f"--nudge {options.nudge}: it must be a number of cells, 0 or more, such as 0.1.")
    writer = find_writer("--out", options.out)
    for path in writer.paths(options.out, options.members or 0):
        find_writer("--out", path)
