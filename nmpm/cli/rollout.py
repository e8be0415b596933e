"""`nmpm rollout MODEL --frames 400 --out out.h5`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.match_options import MatchOptions, add_match_options
from nmpm.cli.options import (
    HelpFormatter,
    add_data_options,
    add_device_option,
    add_model_options,
    add_out_option,
    add_runtime_option,
    add_split_option,
    add_threads_option,
    check_at_least,
    check_device,
    check_exists,
    choose_threads,
    data_options,
    gravity_option,
    stated_facts,
)
from nmpm.data.write import find_writer, write_trajectory
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.emulator import Prescribed, Rollout
    from nmpm.particles import Particles, Window
    from nmpm.scene import Scene
    from nmpm.zoo import Pretrained

FRAMES = 400
"""Predicted of thrown blocks, unless an option says otherwise."""

_EXAMPLES = """\
examples:
  nmpm rollout goop --frames 400 --out out.h5            a zoo model, from thrown blocks
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
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["rollout", "goop", "--frames", "400", "--out", "out.h5"]."""
    options = _parser().parse_args(words[1:])
    _check(options)
    from nmpm.zoo.registry import load_model

    model = load_model(options.model, options.device, options.root)
    hint = _from_blocks(model, options) if options.data is None else _from_recording(model, options)
    sys.stdout.write(f"to look at them: {hint}\n")


def _from_blocks(model: Pretrained, options: argparse.Namespace) -> str:
    """Roll out from thrown blocks; return how to look at what is written."""
    model = _optimized(model, options)
    state = _thrown_state(model, options)
    rollout = _predict(model, state, None, options.frames or FRAMES, options)
    return _write(model, model.scene, state, rollout, None, options)


def _from_recording(model: Pretrained, options: argparse.Namespace) -> str:
    """Roll out from a recorded trajectory and print the errors; return how to look at what is written."""
    from nmpm.cli.recorded_start import RecordedStart
    from nmpm.emulator import Prescribed

    start = RecordedStart.of(model, options)
    model, written = _optimized(start.model, options), start.written
    recorded = written.target.shape[1]
    frames = options.frames or recorded or FRAMES
    prescribed = Prescribed.of(start.window)
    rollout = _predict(model, start.window.initial, prescribed, frames, options, start.between)
    hint = _write(model, start.scene, written.initial, rollout, written if recorded else None, options)
    if recorded:
        _print_errors(start.scene, max(1, model.emulator.frames // start.between), written, rollout, options)
    return hint


def _optimized(model: Pretrained, options: argparse.Namespace) -> Pretrained:
    model = model.optimized(options.runtime, options.precision)
    choose_threads(model, options.threads)
    return model


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nmpm rollout",
        description="Roll a trained model out, from thrown blocks of particles or from a recorded trajectory.",
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    add_model_options(parser)
    add_device_option(parser)
    add_threads_option(parser)
    parser.add_argument("--frames", type=int, help="frames to predict (default: 400; with --data, the recording's)")
    add_out_option(parser, Path("out.h5"))
    parser.add_argument(
        "--data",
        type=Path,
        help="start from a trajectory of this file or folder, of any format that nmpm inspect reads, and print the"
        " error",
    )
    add_split_option(parser, "--data")
    add_match_options(parser)
    add_data_options(parser)
    parser.add_argument("--trajectory", type=int, default=0, help="index in --data (default: 0, the first)")
    parser.add_argument("--seed", type=int, default=0, help="of the thrown blocks (default: 0)")
    parser.add_argument("--particles", type=int, default=1000, help="approximate number to throw (default: 1000)")
    parser.add_argument("--blocks", type=int, help="number of blocks (default: one of each material)")
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
    match = MatchOptions.read(options.materials, options.stride, options.strict)
    data_options(options)
    if options.data is not None:
        check_exists("--data", options.data)
    elif match != MatchOptions():
        raise ConfigError("--materials, --stride and --strict are about recorded data: give --data too.")
    elif facts := [fact for fact in stated_facts(options) if not fact.startswith("--gravity")]:
        raise ConfigError(f"{facts[0]} is about recorded data: give --data too.")
    find_writer("--out", options.out)
    check_device(options.device)


def _thrown_state(model: Pretrained, options: argparse.Namespace) -> Particles:
    gravity = gravity_option(options.gravity)
    try:
        return model.example(options.seed, options.particles, options.blocks, gravity)
    except ConfigError as error:
        blocks = "" if options.blocks is None else f" --blocks {options.blocks}"
        raise ConfigError(f"--particles {options.particles}{blocks}: {error}") from error


def _predict(
    model: Pretrained,
    state: Particles,
    prescribed: Prescribed | None,
    frames: int,
    options: argparse.Namespace,
    between: int = 1,
) -> Rollout:
    """So many frames, of which the model makes `between` each; all but every last of them are left out."""
    from nmpm._support.progress import progress_bar
    from nmpm.emulator import Rollout, stream_rollout
    from nmpm.emulator.input_checks import warn_of_start_outside
    from nmpm.emulator.monitor import Monitor, Policy

    monitor, parts, first, steps = Monitor(Policy(options.watch)), [], between - 1, frames * between
    start, given = state.to(model.emulator.device), prescribed and prescribed.to(model.emulator.device)
    warn_of_start_outside(model.emulator, start)
    with progress_bar("rollout", -(-steps // model.emulator.frames)) as step:
        for bundle in stream_rollout(model.emulator, start, steps, monitor, given):
            kept = slice(first, None, between)
            fields = {name: values[:, kept].cpu() for name, values in bundle.fields.items()}
            parts.append(Rollout(bundle.position[:, kept].cpu(), fields))
            first = (first - bundle.position.shape[1]) % between
            step()
    sys.stdout.write(monitor.report() + "\n")
    return Rollout.join(parts)


def _write(
    model: Pretrained,
    scene: Scene,
    state: Particles,
    rollout: Rollout,
    window: Window | None,
    options: argparse.Namespace,
) -> str:
    """Write the start and the prediction, beside what was recorded; return how to look at them."""
    from nmpm.data.described import described_metadata
    from nmpm.data.predictions import predicted_trajectory

    origin = f"the zoo model {options.model}" if "sha256" in model.card else f"the model {options.model}"
    start = state.to("cpu")
    predicted = predicted_trajectory(
        scene,
        start,
        rollout.position,
        origin,
        fields=rollout.fields,
        truth=None if window is None else window.recorded[:, : rollout.position.shape[1] + 2],
        real=None if window is None else window.mask,
        obstacle_frames=None if window is None else window.obstacle_frames,
    )
    metadata = described_metadata(predicted.attributes, options.out, len(predicted.position))
    file = write_trajectory(options.out, predicted, metadata)
    frames = f"2 frames of the start and {rollout.position.shape[1]} predicted"
    sys.stdout.write(f"wrote {frames}, of {start.position.shape[1]} particles, to {file}\n")
    return find_writer("--out", options.out).hint(file)


def _print_errors(scene: Scene, bundle: int, window: Window, rollout: Rollout, options: argparse.Namespace) -> None:
    """Print the errors against a recording beside those of the trivial predictors, over the frames that both have."""
    from rich.console import Console

    from nmpm.evaluation.comparison import Comparison
    from nmpm.evaluation.figures import error_table
    from nmpm.metrics import MSE

    frames = min(window.target.shape[1], rollout.position.shape[1])
    comparison = Comparison(scene, [MSE()], bundle)
    fields = {name: values[:, :frames] for name, values in rollout.fields.items()}
    comparison.update(window.first(frames + 2), rollout.position[:, :frames], fields)
    figures = {name: float(value) for name, value in comparison.compute().items()}
    what = f"{options.data}, trajectory {options.trajectory}, {frames} frames:"
    Console().print(error_table(what, figures))
