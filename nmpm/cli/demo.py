"""`nmpm demo [MODEL]`: a scene simulated and emulated, with both times, the error, and a page that shows both."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import shlex
import sys
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.options import (
    MODEL,
    CommandParser,
    add_device_option,
    check_at_least,
    check_device,
    check_model,
    check_output,
)
from nmpm.errors import ConfigError, UnstableError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from nmpm.data.format import Trajectory
    from nmpm.emulator import Rollout
    from nmpm.evaluation.trade.ranking import Setting
    from nmpm.particles import Window
    from nmpm.scene import Scene
    from nmpm.sim import Preset

DEFAULT = "dambreak2d"
"""The model of a demonstration that names none."""
FRAMES = 200
"""Of a demonstration, unless an option says otherwise."""

_EXAMPLES = """\
examples:
  nmpm demo                                a dam break: the simulator, and its model
  nmpm demo waterramps --seed 3            water and ramps, another scene
  nmpm demo goop --frames 400 --out goop   goop.h5 and goop.html
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["demo", "waterramps"]."""
    options = _parser().parse_args(words[1:])
    for name, least in (("frames", 1), ("seed", 0)):
        check_at_least(f"--{name}", getattr(options, name), least)
    stem = options.out or Path(f"{Path(options.model).name}-demo")
    file, page = (stem.with_name(f"{stem.name}{suffix}") for suffix in (".h5", ".html"))
    for path in (file, page):
        check_output("--out", path)
    check_model(options.model)
    _check_simulated(options.model)
    check_device(options.device)
    from nmpm._support.devices import device_name
    from nmpm._support.messages import counted
    from nmpm.cli.options import choose_threads
    from nmpm.cli.prediction import predicted, timed_rollout
    from nmpm.data.format import Split, write_split
    from nmpm.emulator.monitor import Monitor, Policy
    from nmpm.evaluation.machine import clock_for
    from nmpm.evaluation.prediction_errors import squared_errors
    from nmpm.evaluation.trade.ranking import Setting
    from nmpm.sim.predictability import twin_of
    from nmpm.viz.files import read_labelled
    from nmpm.viz.viewer import ViewerPage
    from nmpm.zoo import load_model
    from nmpm.zoo.scenes import scene_window, training_preset

    model = load_model(options.model, options.device)
    preset = training_preset(model)
    if preset is None:
        raise ConfigError(_no_simulator(options.model))
    choose_threads(model, 1)  # as many as the simulator's
    sys.stdout.write(f"Scene of {preset.name}, seed {options.seed}; simulator: {preset.generator}.\n")
    simulated, slow = _simulate(preset, options.seed, options.frames + 1)
    window = scene_window(model, simulated)
    clock, read_clock = clock_for(model.emulator.device)
    watch = Monitor(Policy.RECORD)
    rollout, fast = timed_rollout(model, window.initial, options.frames, watch, clock=read_clock)
    error = float(squared_errors(window, rollout.position).mean())
    settings = [Setting("its shipped setting", slow, 0.0)]
    for substeps in sorted({preset.stable_substeps, twin_of(preset).substeps}):
        if substeps < preset.substeps:
            fewer = dataclasses.replace(preset, substeps=substeps)
            with contextlib.suppress(UnstableError):
                again, taken = _simulate(fewer, options.seed, options.frames + 1)
                off = float(squared_errors(window, scene_window(model, again).target).mean())
                settings.append(Setting(f"{counted(substeps, 'substep')} instead of {preset.substeps}", taken, off))
    _print_times(settings, error, fast, f"{clock} on {device_name(model.emulator.device, 1)}")
    _print_errors(model.scene, window, rollout)
    write_split(file, [predicted(model, options.model, model.scene, window.initial, rollout, window)])
    ViewerPage(read_labelled(Split(file))).write(page)
    shown = "opened in the browser" if options.open and _open(page) else "open it in a browser"
    sys.stdout.write(
        f"wrote {page}: {shown}. The positions are in {file}: nmpm render {shlex.quote(str(file))} makes a film.\n"
    )


def _no_simulator(model: str) -> str:
    return (
        f"{model} was not trained on scenes of a shipped simulator, so there is none to set beside it."
        f" nmpm rollout {model} shows what it predicts; nmpm demo {DEFAULT} has a simulator."
    )


def _check_simulated(name: str) -> None:
    """Raise ConfigError, before torch is imported, for a model of the zoo whose card names no simulator."""
    from nmpm.zoo.card import preset_of
    from nmpm.zoo.registry import Zoo

    if name in Zoo.list() and preset_of(Zoo.card(name)) is None:
        raise ConfigError(_no_simulator(name))


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="nmpm demo",
        description="Draw a scene as those that a model learned from, simulate it, emulate it, print both times and the"
        " error, and show both in a browser.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("model", nargs="?", default=DEFAULT, help=f"{MODEL} (default: {DEFAULT})")
    parser.add_argument("--seed", type=int, default=0, help="of the scene (default: 0)")
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"frames to predict (default: {FRAMES})")
    parser.add_argument("--out", type=Path, help="path of both files without suffix (default: MODEL-demo)")
    parser.add_argument("--no-open", dest="open", action="store_false", help="write the page, but do not open it")
    add_device_option(parser, "of the model: ")
    return parser


def _simulate(preset: Preset, seed: int, frames: int) -> tuple[Trajectory, float]:
    """The scene of a seed, and the simulator's milliseconds of CPU time per frame."""
    from nmpm._support.progress import progress_bar
    from nmpm.cli.prediction import milliseconds
    from nmpm.zoo.scenes import simulate_scene

    sys.stdout.flush()
    times = [time.thread_time()]
    with progress_bar(f"simulating, {preset.substeps} substeps a frame", frames) as step:

        def count(_: int) -> None:
            times.append(time.thread_time())
            step()

        simulated = simulate_scene(preset, seed, frames, progress=count)
    return simulated, milliseconds(times, 1)


def _print_times(settings: Sequence[Setting], error: float, fast: float, where: str) -> None:
    """Print milliseconds per frame of the simulator's settings and of the emulator, and the speed-up at equal error.

    Args:
        settings: The shipped one, whose error is 0, first.
        error: The emulator's.
        fast: Milliseconds per frame of the emulator.
        where: Its clock and device.
    """
    from nmpm._support.devices import device_name, find_device
    from nmpm.evaluation.trade.ranking import at_equal_error

    cpu = device_name(find_device("cpu"), 1)
    for setting in settings:
        sys.stdout.write(f"simulator: {setting.milliseconds:.3g} ms per frame, CPU time on {cpu}: {setting.name}\n")
    sys.stdout.write(f"emulator:  {fast:.3g} ms per frame, {where}\n")
    equal = at_equal_error(settings, error) or settings[0]
    sys.stdout.write(
        f"The emulator is {equal.milliseconds / fast:.3g} times as fast at equal error: as the simulator's cheapest of"
        f" these settings that is no less accurate ({equal.name})"
        + (f", {settings[0].milliseconds / fast:.3g} times as fast as its shipped setting" * (equal is not settings[0]))
        + ".\n"
    )


def _print_errors(scene: Scene, window: Window, rollout: Rollout) -> None:
    """Print how far particles are from where the simulator has them, at a few frames."""
    from nmpm.evaluation.comparison import still
    from nmpm.evaluation.prediction_errors import squared_errors

    frames = rollout.position.shape[1]
    side = max(high - low for low, high in scene.bounds)
    made = {"emulator": rollout.position, "nothing moves": still(window.initial, frames)}
    curves = {name: 100 * (scene.dim * squared_errors(window, path)).sqrt() / side for name, path in made.items()}
    shown = sorted({frame for frame in (1, 10, 50, 100, 200, 400) if frame < frames} | {frames})
    sys.stdout.write("distance from the simulated particles, root mean square in % of the box's longest side:\n")
    rows: dict[str, list[float]] = {"at frame": [*shown]}
    rows |= {name: [float(curve[frame - 1]) for frame in shown] for name, curve in curves.items()}
    for name, values in rows.items():
        sys.stdout.write(f"  {name:<14}" + "".join(f"{value:>9.3g}" for value in values) + "\n")


def _open(page: Path) -> bool:
    """Open a page in a browser; False where there is none with a window."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    return webbrowser.open(page.absolute().as_uri())
