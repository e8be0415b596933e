"""`nmpm demo [MODEL]`: a scene simulated and emulated, with both times, the error, and a page that shows both."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shlex
import sys
import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.command import positional
from nmpm.cli.options import DeviceOptions, Natural, Positive, check_model, check_output
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


@dataclass(frozen=True, kw_only=True)
class Demo(DeviceOptions):
    """Show a model beside the simulator that it learned from: times, error, a page.

    It draws a scene as those that a model learned from, simulates it, emulates it, prints both times and the error, and
    shows both in a browser.

    Args:
        model: A model of the zoo (see nmpm zoo list); a path: a run, a checkpoint, or an entry's folder; or an id of
            the Hugging Face hub, owner/repository@revision.
        seed: Of the scene (default: 0).
        frames: Frames to predict.
        out: Path of both files without suffix (default: MODEL-demo).
        no_open: Write the page, but do not open it.
        device: Of the model: auto, cpu, cuda or mps; cuda:1 for the second GPU.

    Examples:
        nmpm demo                                a dam break: the simulator, and its model
        nmpm demo waterramps --seed 3            water and ramps, another scene
        nmpm demo goop --frames 400 --out goop   goop.h5 and goop.html
    """

    model: str = positional(DEFAULT)
    seed: Natural = 0
    frames: Positive = 200
    out: Path | None = None
    no_open: bool = False

    def __post_init__(self) -> None:
        for path in self._files:
            check_output("--out", path)
        check_model(self.model)
        from nmpm.zoo.card import preset_of
        from nmpm.zoo.registry import Zoo

        if self.model in Zoo.list() and preset_of(Zoo.card(self.model)) is None:
            raise self._no_simulator()
        super().__post_init__()

    @property
    def _files(self) -> tuple[Path, Path]:
        stem = self.out or Path(f"{Path(self.model).name}-demo")
        return stem.with_name(f"{stem.name}.h5"), stem.with_name(f"{stem.name}.html")

    def _no_simulator(self) -> ConfigError:
        return ConfigError(
            f"{self.model} was not trained on scenes of a shipped simulator, so there is none to set beside it."
            f" nmpm rollout {self.model} shows what it predicts; nmpm demo {DEFAULT} has a simulator."
        )

    def run(self) -> None:
        from nmpm._support.machine import device_name
        from nmpm._support.messages import counted
        from nmpm.cli.options import choose_threads
        from nmpm.data.format import Split, write_split
        from nmpm.emulator.monitor import Monitor, Policy
        from nmpm.evaluation.machine import clock_for
        from nmpm.evaluation.prediction_errors import squared_errors
        from nmpm.evaluation.trade.ranking import Setting
        from nmpm.sim.preset import twin_of
        from nmpm.viz.files import read_labelled
        from nmpm.viz.viewer import ViewerPage
        from nmpm.zoo import load_model
        from nmpm.zoo.scenes import scene_window, training_preset
        from nmpm.zoo.starts import Start

        (file, page), model = self._files, load_model(self.model, self.device)
        preset = training_preset(model.scene, model.preset)
        if preset is None:
            raise self._no_simulator()
        choose_threads(model, 1)  # as many as the simulator's
        sys.stdout.write(f"Scene of {preset.name}, seed {self.seed}; simulator: {preset.generator}.\n")
        simulated, slow = _simulate(preset, self.seed, self.frames + 1)
        window = scene_window(model.scene, simulated)
        clock, read_clock = clock_for(model.emulator.device)
        start = Start(model, model.scene, window.initial, window.initial, window)
        rollout, fast = start.predict(self.frames, Monitor(Policy.RECORD), read_clock)
        error = float(squared_errors(window, rollout.position).mean())
        settings = [Setting("its shipped setting", slow, 0.0)]
        for substeps in sorted({preset.stable_substeps, twin_of(preset).substeps}):
            if substeps < preset.substeps:
                fewer = dataclasses.replace(preset, substeps=substeps)
                with contextlib.suppress(UnstableError):
                    again, taken = _simulate(fewer, self.seed, self.frames + 1)
                    off = float(squared_errors(window, scene_window(model.scene, again).target).mean())
                    settings.append(Setting(f"{counted(substeps, 'substep')} instead of {preset.substeps}", taken, off))
        _print_times(settings, error, fast, f"{clock} on {device_name(model.emulator.device, 1)}")
        _print_errors(model.scene, window, rollout)
        write_split(file, [start.trajectory(self.model, rollout)])
        ViewerPage(read_labelled(Split(file))).write(page)
        shown = "opened in the browser" if not self.no_open and _open(page) else "open it in a browser"
        sys.stdout.write(
            f"wrote {page}: {shown}. The positions are in {file}: nmpm render {shlex.quote(str(file))} makes a film.\n"
        )


def _simulate(preset: Preset, seed: int, frames: int) -> tuple[Trajectory, float]:
    """The scene of a seed, and the simulator's milliseconds of CPU time per frame."""
    from nmpm._support.progress import progress_bar
    from nmpm.zoo.scenes import simulate_scene
    from nmpm.zoo.starts import milliseconds

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
    from nmpm._support.machine import device_name, find_device
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
