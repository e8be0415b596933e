"""Rollouts of commands: predicted with a progress bar, timed, and written."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from nmpm._support.devices import device_name
from nmpm._support.progress import progress_bar
from nmpm.data.described import described_metadata
from nmpm.data.format import TRUTH, Trajectory
from nmpm.data.predictions import predicted_trajectory
from nmpm.data.write import find_writer, write_trajectory
from nmpm.emulator import Prescribed, Rollout, stream_rollout
from nmpm.emulator.input_checks import warn_of_start_outside
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.evaluation.machine import Clock
from nmpm.particles import Particles, Window
from nmpm.scene import Scene
from nmpm.zoo import Pretrained


def predict(
    model: Pretrained,
    state: Particles,
    frames: int,
    watch: str = "warn",
    prescribed: Prescribed | None = None,
    between: int = 1,
) -> Rollout:
    """Predict so many frames and print what was watched and the time of a frame; see `timed_rollout`."""
    monitor = Monitor(Policy(watch))
    rollout, taken = timed_rollout(model, state, frames, monitor, prescribed, between)
    sys.stdout.write(f"{monitor.report()}\n{taken:.3g} ms per frame on {device_name(model.emulator.device)}.\n")
    return rollout


def timed_rollout(
    model: Pretrained,
    state: Particles,
    frames: int,
    monitor: Monitor,
    prescribed: Prescribed | None = None,
    between: int = 1,
    clock: Clock = time.perf_counter,
) -> tuple[Rollout, float]:
    """Predict so many frames, with a progress bar; with the milliseconds per frame.

    Args:
        model: The model.
        state: That it starts from.
        frames: How many.
        monitor: Watches it.
        prescribed: What moves or enters as recorded.
        between: Frames that the model makes for each of these; all but every last of them are left out.
        clock: That times it, in seconds.
    """
    start, given = on_device(model, state, prescribed)
    stream, times = stream_rollout(model.emulator, start, frames * between, monitor, given), list[float]()
    parts = list(timed_parts(model, "rollout", stream, frames * between, between, times, clock))
    return Rollout.join(parts), milliseconds(times, model.emulator.frames / between)


def on_device(
    model: Pretrained, state: Particles, prescribed: Prescribed | None
) -> tuple[Particles, Prescribed | None]:
    """What a rollout starts from, where the model computes; warns of particles outside of the bounds."""
    start = state.to(model.emulator.device)
    warn_of_start_outside(model.emulator, start)
    return start, prescribed and prescribed.to(model.emulator.device)


def timed_parts(
    model: Pretrained,
    what: str,
    stream: Iterable[Rollout],
    steps: int,
    between: int,
    times: list[float],
    clock: Clock = time.perf_counter,
) -> Iterator[Rollout]:
    """The `kept_frames` of a rollout of so many steps, with a progress bar.

    Adds the time in seconds at the start, and after each bundle, to `times`.
    """
    times.append(clock())
    with progress_bar(what, -(-steps // model.emulator.frames)) as step:
        for part in kept_frames(stream, between):
            times.append(clock())
            yield part
            step()


def milliseconds(times: Sequence[float], frames: float) -> float:
    """Median milliseconds per frame, from times in seconds at the start and after each bundle of so many frames.

    Without the first bundle where there are several, as that may compile programs.
    """
    each = np.diff(times)
    return float(1000 * np.median(each[1:] if len(each) > 1 else each) / frames)


def kept_frames(parts: Iterable[Rollout], between: int) -> Iterator[Rollout]:
    """Every `between`-th frame of the parts of a rollout, on the CPU."""
    first = between - 1
    for part in parts:
        kept = slice(first, None, between)
        fields = {name: values[:, kept].cpu() for name, values in part.fields.items()}
        yield part._replace(position=part.position[:, kept].cpu(), fields=fields)
        first = (first - part.position.shape[1]) % between


def predicted(
    model: Pretrained, name: str, scene: Scene, start: Particles, rollout: Rollout, window: Window | None = None
) -> Trajectory:
    """The start and the prediction of one scene by the model of a name, beside what was recorded in a window."""
    origin = f"the zoo model {name}" if "sha256" in model.card else f"the model {name}"
    return predicted_trajectory(
        scene,
        start.to("cpu"),
        rollout.position,
        origin,
        fields=rollout.fields,
        truth=None if window is None else window.recorded[:, : rollout.position.shape[1] + 2],
        real=None if window is None else window.mask,
        obstacle_frames=None if window is None else window.obstacle_frames,
    )


def write_prediction(out: Path, trajectory: Trajectory) -> str:
    """Write a prediction and print what is in the file; return how to look at it."""
    metadata = described_metadata(trajectory.attributes, out, len(trajectory.position))
    file = write_trajectory(out, trajectory, metadata)
    particles = int(metadata.is_moving(trajectory.particle_type).sum())
    beside = ", beside the recording" if TRUTH in trajectory.fields else ""
    frames = f"2 frames of the start and {len(trajectory.position) - 2} predicted"
    sys.stdout.write(f"wrote {frames}, of {particles} particles{beside}, to {file}\n")
    return find_writer("--out", out).hint(file)
