"""`nmpm demo [MODEL]`: a scene simulated and emulated, with both times, the error, and a page that shows both."""

from __future__ import annotations

import argparse
import os
import sys
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.options import (
    MODEL,
    HelpFormatter,
    add_device_option,
    check_at_least,
    check_device,
    check_model,
    check_output,
)
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.format import Trajectory
    from nmpm.emulator import Rollout
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
    check_device(options.device)
    from nmpm.cli.options import choose_threads
    from nmpm.cli.prediction import predicted, timed_rollout
    from nmpm.data.format import Split, write_split
    from nmpm.emulator.monitor import Monitor, Policy
    from nmpm.viz.files import read_labelled
    from nmpm.viz.viewer import ViewerPage
    from nmpm.zoo import load_model
    from nmpm.zoo.scenes import scene_window, training_preset

    model = load_model(options.model, options.device)
    preset = training_preset(model)
    if preset is None:
        raise ConfigError(
            f"{options.model} was not trained on scenes of a shipped simulator, so there is none to set beside it."
            f" nmpm rollout {options.model} shows what it predicts; nmpm demo {DEFAULT} has a simulator."
        )
    choose_threads(model, 1)  # as many as the simulator's
    simulated, slow = _simulate(preset, options.seed, options.frames + 1)
    window = scene_window(model, simulated)
    rollout, fast = timed_rollout(model, window.initial, options.frames, Monitor(Policy.RECORD))
    _print_times(slow, fast, options.device)
    _print_errors(model.scene, window, rollout)
    write_split(file, [predicted(model, options.model, model.scene, window.initial, rollout, window)])
    ViewerPage(read_labelled(Split(file))).write(page)
    shown = "opened in the browser" if options.open and _open(page) else "open it in a browser"
    sys.stdout.write(f"wrote {page}: {shown}. The positions are in {file}: nmpm render {file} makes a film.\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nmpm demo",
        description="Draw a scene as those that a model learned from, simulate it, emulate it, print both times and the"
        " error, and show both in a browser.",
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("model", nargs="?", default=DEFAULT, help=f"{MODEL} (default: {DEFAULT})")
    parser.add_argument("--seed", type=int, default=0, help="of the scene (default: 0)")
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"frames to predict (default: {FRAMES})")
    parser.add_argument("--out", type=Path, help="path of both files without suffix (default: MODEL-demo)")
    parser.add_argument("--no-open", dest="open", action="store_false", help="write the page, but do not open it")
    add_device_option(parser, "of the model: ")
    return parser


def _simulate(preset: Preset, seed: int, frames: int) -> tuple[Trajectory, float]:
    """The scene of a seed, and the simulator's milliseconds per frame."""
    from nmpm._support.progress import progress_bar
    from nmpm.cli.prediction import milliseconds
    from nmpm.zoo.scenes import simulate_scene

    sys.stdout.write(f"Scene of {preset.name}, seed {seed}; simulator: {preset.generator}.\n")
    sys.stdout.flush()
    times = [time.perf_counter()]
    with progress_bar("simulating", frames) as step:

        def count(_: int) -> None:
            times.append(time.perf_counter())
            step()

        simulated = simulate_scene(preset, seed, frames, progress=count)
    return simulated, milliseconds(times, 1)


def _print_times(slow: float, fast: float, device: str) -> None:
    from nmpm._support.devices import device_name, find_device

    cpu, here = device_name(find_device("cpu"), 1), device_name(find_device(device), 1)
    sys.stdout.write(
        f"simulator: {slow:.3g} ms per frame on {cpu}\n"
        f"emulator:  {fast:.3g} ms per frame on {here}: {slow / fast:.3g} times as fast\n"
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
