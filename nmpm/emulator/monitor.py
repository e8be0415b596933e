"""Watching a rollout: speed, energy, crowding, particles at the walls, and what is no number, while it is made."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from enum import Enum

import torch
from torch import Tensor

from nmpm.emulator.constraints import MOST_GAIN, energy, equal_shares, lowest_potential
from nmpm.emulator.model import Bundle, Emulator
from nmpm.emulator.rasterise import volume_fraction
from nmpm.errors import NmpmError
from nmpm.particles import Particles

_CROWDING_EVERY = 16  # bundles: its sum over particles is as dear as all the rest


class Policy(Enum):
    """What a monitor does when a limit is passed."""

    WARN = "warn"
    STOP = "stop"
    RECORD = "record"


class RolloutStoppedError(NmpmError):
    """A rollout passed a limit of its monitor; what was made until then has been handed out."""


@dataclass(frozen=True)
class Incident:
    """A limit passed for the first time in a rollout.

    Args:
        what: "speed", "energy", "crowding" or "not finite".
        frame: Last frame of the bundle in which it was seen, from 1.
        scene: Of the batch.
        value: What was measured.
        limit: What is allowed.
    """

    what: str
    frame: int
    scene: int
    value: float
    limit: float

    def __str__(self) -> str:
        return f"{self.what} {self.value:.4g} (limit {self.limit:.4g}) in scene {self.scene} by frame {self.frame}"


@dataclass(frozen=True)
class _Reference:
    """The first state's energy (B,), how far it is above the lowest possible (B,), and the shares (B, N, 1)."""

    energy: Tensor
    above_lowest: Tensor
    share: Tensor


@dataclass
class Monitor:
    """Limits that a rollout is watched for, once per bundle.

    Args:
        policy: To warn, once for each kind of incident, to stop, or only to record.
        speed: Largest step of a particle along an axis, in the last frame of a bundle, in the narrowest cells.
        energy_gain: Largest share of the first state's energy that may be gained; not watched where gravity is unknown.
        crowding: Largest volume fraction of a cell, looked at every 16th bundle; the largest that the network is shown
            when left out.

    Attributes:
        incidents: The first of each kind in this rollout.
        peaks: The largest value of each measure in this rollout, by the names that incidents have.
        at_walls: Particles at the scene's bounds or beyond, when crowding was last looked at.
    """

    policy: Policy = Policy.WARN
    speed: float = 4.0
    energy_gain: float = MOST_GAIN
    crowding: float | None = None
    incidents: list[Incident] = field(default_factory=list)
    peaks: dict[str, float] = field(default_factory=dict)
    at_walls: int = 0
    _frames: int = 0
    _bundles: int = 0
    _padded: bool = False
    _reference: _Reference | None = None

    def start(self, emulator: Emulator, particles: Particles) -> None:
        """Forget what was seen, and take a state as the one that a rollout starts from."""
        self.incidents, self.peaks, self.at_walls, self._frames, self._bundles = [], {}, 0, 0, 0
        self._padded = not bool(particles.mask.all())
        if not emulator.scene.gravity_known:
            self._reference = None
            return
        share = equal_shares(particles.mask, particles.position.dtype)
        begun = energy(particles.position, particles.velocity, particles.gravity.unsqueeze(1), share)
        above = begun - lowest_potential(emulator.scene, particles.gravity)
        self._reference = _Reference(begun, above.clamp(min=torch.finfo(begun.dtype).tiny), share)

    def see(self, emulator: Emulator, particles: Particles, bundle: Bundle) -> None:
        """Look at a bundle.

        Args:
            emulator: That made it.
            particles: The state that it started from.
            bundle: Its frames.

        Raises:
            RolloutStoppedError: under the policy "stop", if a limit is passed.
        """
        self._frames += bundle.position.shape[1]
        self._bundles += 1
        if not particles.position.shape[1]:
            return
        last, moving = bundle.position[:, -1], bundle.velocity
        if self._padded:
            moving = moving.masked_fill(~particles.mask.unsqueeze(-1), 0.0)
        way = moving.abs().amax((1, 2)) / min(emulator.grid.spacing)
        # What is no number in a position is none in the velocity, the last step, and none in its largest.
        if not math.isfinite(float(way.max())):
            self._note("not finite", (~way.isfinite()).float(), 0.0)
        self._note("speed", way, self.speed)
        if self._reference is not None:
            now = energy(last, bundle.velocity, particles.gravity.unsqueeze(1), self._reference.share)
            self._note("energy", (now - self._reference.energy) / self._reference.above_lowest, self.energy_gain)
        if self._bundles % _CROWDING_EVERY == 1:
            self._see_crowding_and_walls(emulator, particles, last)

    def _see_crowding_and_walls(self, emulator: Emulator, particles: Particles, last: Tensor) -> None:
        grid, scene = emulator.grid, emulator.scene
        fraction = volume_fraction(scene, grid, emulator.transfer, particles.mask, grid.to_cells(last.nan_to_num()))
        channels = [i for i, name in enumerate(scene.input_channels) if name.endswith(".volume")]
        limit = float(emulator.input_high[channels].max()) if self.crowding is None else self.crowding
        self._note("crowding", fraction.flatten(1).amax(1), limit)
        low, high = last.new_tensor(scene.bounds).T
        self.at_walls = int((((last <= low) | (last >= high)).any(-1) & particles.mask).sum())

    def _note(self, what: str, values: Tensor, limit: float) -> None:
        """Take in a (B,) measure."""
        worst = float(values.max())
        self.peaks[what] = max(self.peaks.get(what, -math.inf), worst)
        if not worst > limit or any(incident.what == what for incident in self.incidents):
            return
        incident = Incident(what, self._frames, int(values.argmax()), worst, limit)
        self.incidents.append(incident)
        if self.policy is Policy.STOP:
            raise RolloutStoppedError(f"The rollout was stopped: {incident}. {self.report()}")
        if self.policy is Policy.WARN:
            warnings.warn(f"The rollout leaves what it is known for: {incident}.", stacklevel=4)

    def report(self) -> str:
        """What was seen, in a sentence or two."""
        seen = ", ".join(f"{what} {value:.3g}" for what, value in self.peaks.items() if what != "not finite")
        passed = "; ".join(map(str, self.incidents)) or "none"
        return f"{self._frames} frames; most: {seen}; {self.at_walls} particles at the walls. Limits passed: {passed}."
