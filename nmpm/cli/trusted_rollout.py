"""`nmpm rollout --until trusted`, and `--fallback PRESET`: a simulator goes on from the last trusted frame."""

from __future__ import annotations

import argparse
import sys

from nmpm._support.progress import progress_bar
from nmpm.cli.prediction import on_device, timed_parts
from nmpm.emulator import Prescribed, Rollout
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.emulator.trust import TrustTracker, stream_watched, until_trusted
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.sim import Preset, load_preset
from nmpm.zoo import Pretrained
from nmpm.zoo.fallback import fitting_preset, simulate_rest


def predict_trusted(
    model: Pretrained,
    state: Particles,
    prescribed: Prescribed | None,
    frames: int,
    options: argparse.Namespace,
    between: int = 1,
) -> Rollout:
    """The frames that are trusted, of so many at most; with a fallback all, those that follow simulated.

    Args:
        model: The model.
        state: Of one scene.
        prescribed: What moves or enters as recorded.
        frames: How many to write at most.
        options: Of the command.
        between: Frames of the model per written frame.

    Raises:
        ConfigError: if the fallback does not fit, or no frame is trusted and there is none.
    """
    preset = _fallback(model, state, prescribed, options, between)
    start, given = on_device(model, state, prescribed)
    tracker, monitor = TrustTracker(model.scene, start, model.trust), Monitor(Policy(options.watch))
    watched = stream_watched(model.emulator, start, frames * between, tracker, prescribed=given, monitor=monitor)
    parts = until_trusted(watched, tracker)
    trusted = Rollout.join(list(timed_parts(model, "rollout", parts, frames * between, between, [])))
    sys.stdout.write(f"{monitor.report()}\n")
    if preset is not None:
        return _simulate_rest(model, state, trusted._replace(trusted=tracker.frames), preset, frames)
    if not trusted.position.shape[1]:
        raise ConfigError(f"--until trusted: no frame is. {tracker.report()} Without it, all are written.")
    return trusted


def _fallback(
    model: Pretrained, state: Particles, prescribed: Prescribed | None, options: argparse.Namespace, between: int
) -> Preset | None:
    """The preset of --fallback, if there is one, checked before any work."""
    if options.fallback is None:
        return None
    if prescribed is not None or between > 1:
        raise ConfigError(
            f"--fallback {options.fallback}: a simulator goes on from what moves freely, in the model's own frames; "
            + ("these data prescribe motion." if prescribed is not None else "--stride asks for others.")
        )
    return fitting_preset(model.scene, state, load_preset(options.fallback))


def _simulate_rest(model: Pretrained, state: Particles, trusted: Rollout, preset: Preset, frames: int) -> Rollout:
    """All frames; says which of them are simulated."""
    made = trusted.position.shape[1]
    if made == frames:
        return trusted
    with progress_bar(f"Simulating {preset.name}", frames - made) as step:
        whole = simulate_rest(model.scene, state.to("cpu"), trusted, preset, frames, lambda _: step())
    sys.stdout.write(f"frames {made + 1} to {frames} are simulated by {preset.name} ({preset.generator})\n")
    return whole
