"""Rollouts: call the emulator bundle after bundle, from one state, for as many frames as asked.

`stream_rollout` is the one way to roll out without gradients: of one future or of members, watched or not. The other
functions are views of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from nmpm._support.plain_data import check_whole
from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.members import batches_of, check_members, member_starts, noise_seed, nudge_of
from nmpm.emulator.model import Emulator
from nmpm.emulator.monitor import Monitor, check_inputs, warn_of_training_mode
from nmpm.emulator.noise import Noise
from nmpm.emulator.periods import Periods
from nmpm.emulator.prescribed import Exchange, Prescribed
from nmpm.emulator.trust import COMPANIONS, TrustTracker
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.transfer import is_eager_cpu

Call = Callable[[Emulator, Particles, RolloutContext], Bundle]


@dataclass(frozen=True)
class RolloutOptions:
    """What a rollout is given beside its state and its number of frames.

    Args:
        prescribed: Particles that enter and leave, and obstacles that move; the same for all members.
        noise: What a stochastic processor reads, which without any predicts one future. Members draw their own.
        monitor: Watches each bundle; of members all of them, its scenes the M·B rows.
        members: M, how many rollouts of each scene, see `nmpm.emulator.members`; None for one from the state as it is.
        seed: Of the members' noise and nudges.
        nudge: Standard deviation in cells of the displacements of members' starts, see `member_starts`.
        tracker: Watches how far the rollouts part. A single one, of which nothing changes, is compared with
            `COMPANIONS` that start nearby, whatever the nudge: three rollouts cost about three times as much. Of
            several members each is compared with each.
        until_trusted: End with the last frame of any scene that the tracker trusts. Positions and fields of a scene
            that is lost earlier than others of its batch are NaN from then on.

    Raises:
        ConfigError: if `members`, `seed` or `nudge` is too small, or there is no tracker to trust.
    """

    prescribed: Prescribed | None = None
    noise: Noise | None = None
    monitor: Monitor | None = None
    members: int | None = None
    seed: int = 0
    nudge: float | None = None
    tracker: TrustTracker | None = None
    until_trusted: bool = False

    def __post_init__(self) -> None:
        check_members(1 if self.members is None else self.members, self.seed, self.nudge)
        if self.until_trusted and self.tracker is None:
            raise ConfigError("until_trusted: a tracker says which frames are: give tracker=TrustTracker(…), too.")


PLAIN = RolloutOptions()
"""One rollout of what moves freely, as the processor predicts it without noise."""


def unroll(
    emulator: Emulator,
    particles: Particles,
    bundles: int,
    options: RolloutOptions = PLAIN,
    frames: int | None = None,
) -> Iterator[Bundle]:
    """Predict bundle after bundle, each from the last, keeping gradients where they are enabled.

    Particles beyond the bounds of an open axis leave after the bundle, unless those that leave are prescribed. Where
    particles enter or leave, positions and fields of those that are not there are NaN.

    On a CPU, scenes whose state no longer changes are repeated without a call. The monitor measures each bundle before
    it is yielded, and names no frame beyond the number that is used, `frames`; all if that is left out. Of one rollout:
    members and trust are left to `stream_rollout`.
    """
    prescribed, monitor = options.prescribed, options.monitor
    exchange = Exchange(emulator, prescribed)
    particles = exchange.start(particles)
    if monitor is not None:
        monitor.start(emulator, particles, frames)
        if prescribed is not None or exchange.varies:
            monitor.ignore_energy()
    periods = Periods(emulator)
    particles = periods.wrap(particles)
    calls = _Calls(emulator, particles, exchange, options.noise)
    for index in range(bundles):
        bundle = calls.predict(particles)
        travelled = periods.unwrapped(bundle)
        if monitor is not None:
            monitor.see(emulator, periods.unwrapped_state(particles), travelled)
            if index == bundles - 1:
                monitor.read()
        frame = index * emulator.frames
        yield travelled.without_absent(exchange.there(particles, frame)) if exchange.varies else travelled
        after, frame = bundle.state_after(particles), frame + emulator.frames
        if exchange.varies:
            periods.forget(~exchange.stays(after, frame))
        after = periods.wrap(exchange.after(after, frame))
        calls.prepare(particles, after)
        particles = after


class _Calls:
    """The calls of a rollout, of the scenes that are not at rest."""

    def __init__(self, emulator: Emulator, particles: Particles, exchange: Exchange, noise: Noise | None) -> None:
        self._emulator, self._count, self._exchange, self._noise = emulator, len(particles.position), exchange, noise
        self._context = self._moving_context = exchange.first_context(particles)
        self._moving, self._last = list(range(self._count)), Bundle(particles.position, particles.velocity)

    def predict(self, particles: Particles) -> Bundle:
        """The next bundle of all scenes."""
        if len(self._moving) == self._count:
            self._last = self._emulator(particles, self._call_context())
        elif self._moving:
            moving = self._emulator(particles.scenes(self._moving), self._call_context())
            fields = {name: self._put(values, moving.fields[name]) for name, values in self._last.fields.items()}
            position = self._put(self._last.position, moving.position)
            velocity = self._put(self._last.velocity, moving.velocity)
            self._last = Bundle(position, velocity, fields, self._last.budget)
        return self._last

    def _call_context(self) -> RolloutContext:
        context = self._moving_context
        return context if self._noise is None else self._noise.in_context(context, self._moving)

    def _put(self, values: Tensor, moving: Tensor) -> Tensor:
        """Values (B, …) with those of the scenes that move replaced."""
        values = values.clone()
        values[self._moving] = moving
        return values

    def prepare(self, before: Particles, after: Particles) -> None:
        """Prepare the call from the state `after`, whose bundle before started from `before`."""
        if self._exchange.prescribed is None:
            self._leave_out_resting(before, after)
        else:
            self._context = self._moving_context = self._exchange.next_context(self._context, after)

    def _leave_out_resting(self, before: Particles, after: Particles) -> None:
        """Stop predicting scenes whose state no longer changes; all or none where a smaller batch would be compiled."""
        if self._emulator.training or not is_eager_cpu(after.position) or after.position.requires_grad:
            return
        moving = [scene for scene in self._moving if not _is_same_state(before, after, scene)]
        if len(moving) == len(self._moving) or (moving and self._emulator.shapes_are_compiled):
            return
        self._moving, self._moving_context = moving, self._context.scenes(moving)


def _is_same_state(before: Particles, after: Particles, scene: int) -> bool:
    """Whether a scene has the same motion and fields in two states, to the bit."""
    if any(name not in before.fields for name in after.fields):
        return False
    pairs = [(before.velocity, after.velocity), (before.position, after.position)]
    pairs += [(before.fields[name], values) for name, values in after.fields.items()]
    return all(torch.equal(one[scene], other[scene]) for one, other in pairs)


class Rollout(NamedTuple):
    """Predicted frames.

    Args:
        position: (B, T, N, D) in domain length.
        fields: (B, T, N) of each evolving field, by name, in its own unit.
        trusted: (B,) frames up to which each scene is trusted; None where that was not asked for.
    """

    position: Tensor
    fields: Mapping[str, Tensor]
    trusted: Tensor | None = None

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

    def by_member(self, members: int) -> Rollout:
        """The rows (M·B, …) of M members as (M, B, …)."""
        fields = {name: values.unflatten(0, (members, -1)) for name, values in self.fields.items()}
        return self._replace(position=self.position.unflatten(0, (members, -1)), fields=fields)

    def cpu(self) -> Rollout:
        """The same on the CPU."""
        return Rollout(self.position.cpu(), {name: values.cpu() for name, values in self.fields.items()})


def stream_rollout(
    emulator: Emulator, particles: Particles, frames: int, options: RolloutOptions = PLAIN
) -> Iterator[Rollout]:
    """Predict `frames` frames of positions and evolving fields without gradients, yielding up to m as they are made.

    Members are computed in batches of as many scenes as `MOST_SCENES` and `MOST_CELLS` allow, all batches bundle by
    bundle: memory holds the activations of one. Members that do not differ, without noise and nudge, are computed once.

    Warns if the emulator is in training mode, in which constraints do not act.

    Yields:
        Positions (B, <= m, N, D) and fields (B, <= m, N); of members (M·B, …), rows 0 … B - 1 those of member 0.
        Positions of particles that are not there, which have left through an open axis or as prescribed, or are yet
        to enter, are NaN.

    Raises:
        ConfigError: if `frames` is negative, or no whole number.
        DataError: if the state or a weight is not finite, a particle is outside of the domain, or what is prescribed
            are other particles than the state's.
        RolloutStoppedError: if the monitor stops the rollout.
    """
    if options.tracker is not None:
        watched = _stream_watched(emulator, particles, frames, options, options.tracker)
        return _trusted_frames(watched, options.tracker) if options.until_trusted else watched
    if options.members is not None:
        return _stream_members(emulator, particles, frames, options, options.members)
    return _stream_one(emulator, particles, frames, options)


def _stream_one(emulator: Emulator, particles: Particles, frames: int, options: RolloutOptions) -> Iterator[Rollout]:
    frames = check_whole("frames", frames, 0)
    warn_of_training_mode(emulator)
    check_inputs(emulator, particles)
    bundles = unroll(emulator, particles, -(-frames // emulator.frames), options, frames)
    made = 0
    while made < frames:
        with torch.no_grad():  # entered anew for each bundle: a suspended generator must not leak the mode
            bundle = next(bundles)
        kept = slice(frames - made)
        fields = {name: values[:, kept] for name, values in bundle.fields.items()}
        part = Rollout(bundle.position[:, kept], fields)
        made += part.position.shape[1]
        yield part


def _stream_members(
    emulator: Emulator, state: Particles, frames: int, options: RolloutOptions, members: int
) -> Iterator[Rollout]:
    seed, nudge, prescribed, monitor = options.seed, options.nudge, options.prescribed, options.monitor
    starts = member_starts(emulator, state, members, seed, nudge)
    if not (emulator.processor.noise or nudge_of(emulator, nudge)):
        for part in _stream_one(emulator, state, frames, options):
            yield Rollout.stack([part] * members)
        return
    scenes = len(state.position)
    batches = batches_of(emulator, members * scenes)
    monitors = [monitor and replace(monitor, first_scene=rows.start) for rows in batches]
    streams = []
    for rows, watch in zip(batches, monitors, strict=True):
        given = prescribed and prescribed.scenes([row % scenes for row in rows])
        noise = Noise(emulator, [noise_seed(seed, row, scenes) for row in rows])
        start = starts.scenes(slice(rows.start, rows.stop))
        streams.append(_stream_one(emulator, start, frames, RolloutOptions(given, noise, watch)))
    try:
        for parts in zip(*streams, strict=True):
            yield Rollout.stack(parts)
    finally:
        if monitor is not None:
            monitor.gather([watch for watch in monitors if watch is not None])


def _stream_watched(
    emulator: Emulator, state: Particles, frames: int, options: RolloutOptions, tracker: TrustTracker
) -> Iterator[Rollout]:
    """All frames, while the tracker watches how far the rollouts part."""
    streams = [stream_rollout(emulator, state, frames, replace(options, tracker=None, until_trusted=False))]
    if options.members is None or options.members == 1:
        beside = RolloutOptions(options.prescribed, members=COMPANIONS, seed=options.seed + 1)
        streams.append(stream_rollout(emulator, state, frames, beside))
    for parts in zip(*streams, strict=True):
        tracker.see(torch.cat([part.position for part in parts]).unflatten(0, (-1, len(state.position))))
        if options.monitor is not None:
            options.monitor.trust = tracker.report()
        yield parts[0]


def _trusted_frames(parts: Iterator[Rollout], tracker: TrustTracker) -> Iterator[Rollout]:
    """The frames that a tracker, which has seen them, trusts, up to the last one of any scene."""
    made = 0
    for part in parts:
        kept = int(tracker.frames.max()) - made
        index = torch.arange(made + 1, tracker.made + 1)
        there = (index <= tracker.frames[:, None]).repeat(len(part.position) // len(tracker.frames), 1)
        there = there.to(part.position.device)[..., None]
        position = part.position.where(there[..., None], torch.nan)[:, :kept]
        fields = {name: values.where(there, torch.nan)[:, :kept] for name, values in part.fields.items()}
        yield Rollout(position, fields)
        made = tracker.made
        if kept < len(index):
            return


def rollout(emulator: Emulator, particles: Particles, frames: int, options: RolloutOptions = PLAIN) -> Tensor:
    """(B, frames, N, D) positions in domain length of `predict_rollout`."""
    return predict_rollout(emulator, particles, frames, options).position


def predict_rollout(emulator: Emulator, particles: Particles, frames: int, options: RolloutOptions = PLAIN) -> Rollout:
    """All frames of `stream_rollout` at once; of M members (M, B, frames, N, D) and fields (M, B, frames, N)."""
    batch, *rest = particles.position.shape
    parts = list(stream_rollout(emulator, particles, frames, options)) if batch else []
    if parts:
        made = Rollout.join(parts)
    else:  # of no scene, or of no frame
        none = particles.position.new_zeros(batch * (options.members or 1), frames, *rest)
        made = Rollout(none, dict.fromkeys(emulator.scene.evolving, none[..., 0]))
    if options.until_trusted and options.tracker is not None:
        made = made._replace(trusted=options.tracker.frames)
    return made if options.members is None else made.by_member(options.members)


def unroll_with_gradients(
    emulator: Emulator,
    particles: Particles,
    bundles: int,
    call: Call,
    state_after: Callable[[Bundle, Particles], Particles] = Bundle.state_after,
    prescribed: Prescribed | None = None,
    noise: Sequence[Tensor] | None = None,
) -> Iterator[Bundle]:
    """Predict bundle after bundle with gradients, each by a `call` such as `recomputed`.

    The next bundle starts from the `state_after` a bundle, of what that started from, with what is `prescribed`. A
    stochastic processor reads the `noise` (B, Z, *S) of each call.
    Positions of particles that are not there are finite, and mean nothing.
    """
    exchange = Exchange(emulator, prescribed)
    particles = exchange.start(particles)
    context = exchange.first_context(particles)
    for index in range(bundles):
        bundle = call(emulator, particles, context if noise is None else replace(context, noise=noise[index]))
        yield bundle
        particles = exchange.after(state_after(bundle, particles), (index + 1) * emulator.frames)
        context = exchange.next_context(context, particles)


def recomputed(emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
    """A call of the emulator that keeps no activations: backward passes compute it again."""
    bundle: Bundle = checkpoint(emulator, particles, context, use_reentrant=False)
    return bundle


def differentiable_rollout(emulator: Emulator, particles: Particles, frames: int) -> Tensor:
    """Predict `frames` frames (B, frames, N, D) with gradients to the state: positions, velocities, obstacles, gravity.

    The trajectories of liquids are chaotic: over long rollouts gradients grow without bound and say less and less.
    Optimise over the shortest horizon that the purpose allows, clip gradients, or average them over several slightly
    different states of a batch.

    Args:
        emulator: In evaluation mode; its own parameters should not require gradients
            (`emulator.requires_grad_(False)`), which saves time.
        particles: The state to start from, see `Pretrained.state`, which keeps gradients of what it is given.
        frames: How many frames to predict, at least 1.

    Raises and warns as `stream_rollout`.
    """
    frames = check_whole("frames", frames, 1)
    warn_of_training_mode(emulator)
    with torch.no_grad():
        check_inputs(emulator, particles)
    periods = Periods(emulator)
    bundles = unroll_with_gradients(
        emulator,
        periods.wrap(particles),
        -(-frames // emulator.frames),
        recomputed,
        lambda bundle, start: periods.wrap(bundle.state_after(start)),
    )
    return torch.cat([periods.unwrapped(bundle).position for bundle in bundles], dim=1)[:, :frames]
