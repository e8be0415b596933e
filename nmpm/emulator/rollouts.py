"""Rollouts: call the emulator bundle after bundle, from one state, for as many frames as asked."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nmpm._support.numbers import check_whole
from nmpm.emulator.bundle import Bundle
from nmpm.emulator.model import Emulator
from nmpm.emulator.monitor import Monitor
from nmpm.emulator.periods import Periods
from nmpm.errors import DataError
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.transfer.execution import is_eager_cpu

ROUNDING = 1e-3
"""Cells by which particles may start outside of the bounds without a warning."""


def unroll(
    emulator: Emulator, particles: Particles, bundles: int, monitor: Monitor | None = None, frames: int | None = None
) -> Iterator[Bundle]:
    """Predict bundle after bundle, each from the last, keeping gradients where they are enabled.

    Once a scene's bundle ends in exactly the state that it started from, as at rest, all further ones would be the
    same: it is repeated without a call. Only on a CPU, as comparing states elsewhere would halt the device.

    Args:
        emulator: Predicts m frames a call.
        particles: The state to start from.
        bundles: How many calls to make.
        monitor: Measures each bundle before it is yielded.
        frames: Number of frames that are used, if not all: the monitor names none beyond.
    """
    if monitor is not None:
        monitor.start(emulator, particles, frames)
    periods = Periods(emulator)
    particles = periods.wrap(particles)
    calls = _Calls(emulator, particles)
    for remaining in reversed(range(bundles)):
        bundle = calls.predict(particles)
        travelled = periods.unwrapped(bundle)
        if monitor is not None:
            monitor.see(emulator, periods.unwrapped_state(particles), travelled)
            if not remaining:
                monitor.read()
        yield travelled
        after = periods.wrap(bundle.state_after(particles))
        calls.let_sleep(particles, after)
        particles = after


class _Calls:
    """The calls of a rollout, of the scenes that are not at rest.

    Args:
        emulator: Predicts m frames a call.
        particles: The state to start from.
    """

    def __init__(self, emulator: Emulator, particles: Particles) -> None:
        self._context = self._own = emulator.context(particles)
        self._emulator, self._count = emulator, len(particles.position)
        self._awake, self._last = list(range(self._count)), Bundle(particles.position, particles.velocity)

    def predict(self, particles: Particles) -> Bundle:
        """The next bundle of all scenes."""
        if len(self._awake) == self._count:
            self._last = self._emulator(particles, self._own)
        elif self._awake:
            moving = self._emulator(particles.scenes(self._awake), self._own)
            fields = {name: self._put(values, moving.fields[name]) for name, values in self._last.fields.items()}
            position = self._put(self._last.position, moving.position)
            self._last = Bundle(position, self._put(self._last.velocity, moving.velocity), fields)
        return self._last

    def _put(self, values: Tensor, moving: Tensor) -> Tensor:
        """Values (B, …) with those of the scenes that are awake replaced."""
        values = values.clone()
        values[self._awake] = moving
        return values

    def let_sleep(self, before: Particles, after: Particles) -> None:
        """Leave scenes out of further calls that the last one left as they were, to the bit.

        All or none where another number of scenes would be compiled anew.
        """
        if self._emulator.training or not is_eager_cpu(after.position) or after.position.requires_grad:
            return
        awake = [scene for scene in self._awake if not _is_same_state(before, after, scene)]
        if len(awake) == len(self._awake) or (awake and self._emulator.shapes_are_compiled):
            return
        self._awake, self._own = awake, self._context.scenes(awake)


def _is_same_state(before: Particles, after: Particles, scene: int) -> bool:
    """Whether a scene has the same motion and fields in two states, to the bit."""
    pairs = [(before.velocity, after.velocity), (before.position, after.position)]
    if any(name not in before.fields for name in after.fields):
        return False
    pairs += [(before.fields[name], values) for name, values in after.fields.items()]
    return all(torch.equal(one[scene], other[scene]) for one, other in pairs)


class _Numbers(NamedTuple):
    """Numbers of a state that must be finite.

    Args:
        place: What an error calls one of them, with the index into K.
        values: (B, K, V).
        counts: (B, K) bool, False for padding.
    """

    place: str
    values: Tensor
    counts: Tensor

    @property
    def wrong(self) -> Tensor:
        """(B, K) bool."""
        return ~self.values.isfinite().all(-1) & self.counts


def _state_numbers(particles: Particles) -> list[_Numbers]:
    real = particles.mask
    vectors = {name: getattr(particles, name) for name in ("position", "velocity")}
    numbers = {name: values.unsqueeze(-1) for name, values in particles.fields.items()}
    return [
        *(
            _Numbers(f"particle {{}}: its {name}", values.expand(*real.shape, -1), real)
            for name, values in (vectors | numbers).items()
        ),
        _Numbers("obstacle particle {}: its position", particles.obstacle, particles.obstacle_mask),
        _Numbers("its gravity", particles.gravity.unsqueeze(1), torch.ones_like(real[:, :1])),
    ]


def check_inputs(emulator: Emulator, particles: Particles) -> None:
    """Reject emulators with non-finite weights, and states that are non-finite or outside of the domain.

    All checks are read back from the device at once; details are computed only if one fails.

    Args:
        emulator: Is to predict.
        particles: The state to start from.

    Raises:
        DataError: naming the weight or statistic; or scene, particle and value.
    """
    real, materials = particles.mask, emulator.scene.materials
    numbers = _state_numbers(particles)
    wrong = [given.wrong for given in numbers]
    beyond = beyond_walls(emulator.scene, particles.position) & real
    unknown = ((particles.material < 0) | (particles.material >= len(materials))) & real
    weights = emulator.state_dict()
    unsound = [~values.isfinite().all() for values in weights.values()]
    checks = [torch.stack(unsound).any(), *(bad.any() for bad in (*wrong, unknown, beyond))]
    if not bool(torch.stack(checks).any()):
        return
    for name, bad in zip(weights, unsound, strict=True):
        if bad:
            raise DataError(f"The emulator's {name} holds values that are not finite: load a sound checkpoint.")
    for given, bad in zip(numbers, wrong, strict=True):
        if bad.any():
            scene, index = map(int, bad.nonzero()[0])
            raise DataError(
                f"Scene {scene} of the batch, {given.place.format(index)} is {given.values[scene, index].tolist()}; it"
                " must be finite."
            )
    if unknown.any():
        scene, particle = map(int, unknown.nonzero()[0])
        kind = int(particles.material[scene, particle])
        raise DataError(
            f"Scene {scene} of the batch, particle {particle}: its material is {kind}; it must be an index, from 0,"
            f" into the model's {len(materials)} ({', '.join(materials)})."
        )
    scene, particle = map(int, beyond.nonzero()[0])
    raise DataError(
        f"Scene {scene} of the batch, particle {particle}: it is at {particles.position[scene, particle].tolist()},"
        f" outside of the domain {list(emulator.scene.domain)} ({int(beyond.sum())} particles are)."
    )


def warn_of_training_mode(emulator: Emulator) -> None:
    """Warn of an emulator in training mode, such as a module's own, whose rollouts would be other than intended."""
    held = emulator.constraints
    constrained = held.energy or held.rest_speed or held.density_cap or (held.solids and emulator.scene.obstacles)
    if emulator.training and (constrained or emulator.recipe.grid_noise):
        warnings.warn(
            "The emulator is in training mode, in which rollouts obey none of its constraints but the bounds, and the"
            " network's input gets the noise of trainings: call emulator.eval() first.",
            stacklevel=4,
        )


def warn_of_start_outside(emulator: Emulator, particles: Particles) -> None:
    """Warn of particles that start outside of the bounds by more than rounding: the first frame moves them in."""
    scene = emulator.scene
    sides = [
        torch.zeros_like(column) if wraps else torch.maximum(low - column, column - high)
        for column, (low, high), wraps in zip(particles.position.unbind(-1), scene.bounds, scene.periodic, strict=True)
    ]
    apart = torch.stack(sides).amax(0).masked_fill(~particles.mask, 0.0)
    outside = apart > ROUNDING * min(emulator.grid.spacing)
    if outside.any():
        warnings.warn(
            f"{int(outside.sum())} of {int(particles.mask.sum())} particles start outside of the bounds"
            f" {list(scene.bounds)}, by up to {float(apart.max()):.3g}: rollouts move them in.",
            stacklevel=4,
        )


def beyond_walls(scene: Scene, position: Tensor) -> Tensor:
    """Whether positions (..., D) are outside of the domain, (...) bool: never along periodic axes."""
    sides = [
        torch.zeros_like(column, dtype=torch.bool) if wraps else (column < low) | (column > high)
        for column, (low, high), wraps in zip(position.unbind(-1), scene.domain, scene.periodic, strict=True)
    ]
    return torch.stack(sides).any(0)


class Rollout(NamedTuple):
    """Predicted frames.

    Args:
        position: (B, T, N, D) in domain length.
        fields: (B, T, N) of each evolving field, by name, in its own unit.
    """

    position: Tensor
    fields: Mapping[str, Tensor]

    @classmethod
    def join(cls, parts: Sequence[Rollout]) -> Rollout:
        """Consecutive parts, at least one, as one."""
        names = parts[0].fields
        fields = {name: torch.cat([part.fields[name] for part in parts], dim=1) for name in names}
        return cls(torch.cat([part.position for part in parts], dim=1), fields)

    @classmethod
    def stack(cls, parts: Sequence[Rollout]) -> Rollout:
        """The scenes of several rollouts of as many frames, at least one, in one."""
        fields = {name: torch.cat([part.fields[name] for part in parts]) for name in parts[0].fields}
        return cls(torch.cat([part.position for part in parts]), fields)

    def cpu(self) -> Rollout:
        """The same on the CPU."""
        return Rollout(self.position.cpu(), {name: values.cpu() for name, values in self.fields.items()})


def stream(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Iterator[Tensor]:
    """Predict `frames` frames without gradients, yielding each bundle's positions as it is made.

    Yields:
        (B, <= m, N, D) positions in domain length; the last bundle is cut to the frames asked for.

    Raises:
        As `stream_rollout`.
    """
    for part in stream_rollout(emulator, particles, frames, monitor):
        yield part.position


def stream_rollout(
    emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None
) -> Iterator[Rollout]:
    """Predict `frames` frames of positions and evolving fields without gradients, yielding each bundle as it is made.

    Yields:
        Up to m frames; the last bundle is cut to the frames asked for.

    Raises:
        ConfigError: if `frames` is negative, or no whole number.
        DataError: if the state or a weight is not finite, or a particle is outside of the domain.
        RolloutStoppedError: if the monitor stops the rollout.

    Warns:
        UserWarning: if the emulator is in training mode, in which constraints do not act.
    """
    frames = check_whole("frames", frames, 0)
    warn_of_training_mode(emulator)
    check_inputs(emulator, particles)
    bundles = unroll(emulator, particles, -(-frames // emulator.frames), monitor, frames)
    made = 0
    while made < frames:
        with torch.no_grad():  # entered anew for each bundle: a suspended generator must not leak the mode
            bundle = next(bundles)
        kept = slice(frames - made)
        fields = {name: values[:, kept] for name, values in bundle.fields.items()}
        part = Rollout(bundle.position[:, kept], fields)
        made += part.position.shape[1]
        yield part


def rollout(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Tensor:
    """Predict `frames` frames without gradients.

    Returns:
        (B, frames, N, D) positions in domain length.

    Raises:
        As `predict_rollout`.
    """
    return predict_rollout(emulator, particles, frames, monitor).position


def predict_rollout(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Rollout:
    """Predict `frames` frames of positions and evolving fields without gradients.

    Raises:
        ConfigError: if `frames` is negative, or no whole number.
        DataError: if the state or a weight is not finite, or a particle is outside of the domain.
        RolloutStoppedError: if the monitor stops the rollout.

    Warns:
        UserWarning: if the emulator is in training mode, in which constraints do not act.
    """
    batch, *rest = particles.position.shape
    parts = list(stream_rollout(emulator, particles, frames, monitor)) if batch else []
    if parts:
        return Rollout.join(parts)
    none = particles.position.new_zeros(batch, frames, *rest)  # of no scene, or of no frame
    return Rollout(none, dict.fromkeys(emulator.scene.evolving, none[..., 0]))
