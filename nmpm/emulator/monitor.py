"""Checks of the states that rollouts start from, and the monitor of a rollout as it is made.

It watches speed, energy, crowding, non-finite values and particles at the walls.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import torch
from torch import Tensor

from nmpm.emulator.bundle import Bundle
from nmpm.emulator.constraints import MOST_GAIN, distance_beyond, energy, lowest_potential, mass_shares
from nmpm.emulator.model import Emulator
from nmpm.emulator.rasterise import volume_fraction
from nmpm.errors import DataError, NmpmError
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.transfer import is_eager_cpu

ROUNDING = 1e-3
"""Cells by which particles may start outside of the bounds without a warning."""


class _Numbers(NamedTuple):
    """Numbers (B, K, V) of a state that must be finite where they are real (B, K), and what an error calls them."""

    name: str
    values: Tensor
    real: Tensor

    @property
    def wrong(self) -> Tensor:
        """(B, K) bool."""
        return ~self.values.isfinite().all(-1) & self.real


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
        *_optional_numbers(particles),
        _Numbers("its gravity", particles.gravity.unsqueeze(1), torch.ones_like(real[:, :1])),
    ]


def _optional_numbers(particles: Particles) -> Iterator[_Numbers]:
    if particles.volume is not None:
        yield _Numbers("particle {}: its volume", particles.volume.unsqueeze(-1), particles.mask)
    if particles.obstacle_velocity is not None:
        yield _Numbers("obstacle particle {}: its velocity", particles.obstacle_velocity, particles.obstacle_mask)


def check_inputs(emulator: Emulator, particles: Particles) -> None:
    """Raise DataError for emulators with non-finite weights, and states that are non-finite or outside of the domain.

    All checks are read back from the device at once; details are computed only if one fails.
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
                f"Scene {scene} of the batch, {given.name.format(index)} is {given.values[scene, index].tolist()}; it"
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
    limits = emulator.constraints
    constrained = limits.energy or limits.rest_speed or limits.density_cap
    constrained = constrained or (limits.solids and emulator.scene.obstacles)
    if emulator.training and (constrained or emulator.recipe.grid_noise):
        warnings.warn(
            "The emulator is in training mode, in which rollouts obey none of its constraints but the bounds, and the"
            " network's input gets the noise of trainings: call emulator.eval() first.",
            stacklevel=4,
        )


def warn_of_start_outside(emulator: Emulator, particles: Particles) -> None:
    """Warn of particles that start outside of the bounds by more than rounding: the first frame moves them in."""
    scene = emulator.scene
    apart = distance_beyond(particles.position, scene.bounds, scene.confined).masked_fill(~particles.mask, 0.0)
    outside = apart > ROUNDING * min(emulator.grid.spacing)
    if outside.any():
        warnings.warn(
            f"{int(outside.sum())} of {int(particles.mask.sum())} particles start outside of the bounds"
            f" {list(scene.bounds)}, by up to {float(apart.max()):.3g}: rollouts move them in.",
            stacklevel=4,
        )


def beyond_walls(scene: Scene, position: Tensor) -> Tensor:
    """Whether positions (..., D) are outside of the domain, (...) bool: never along periodic axes."""
    return distance_beyond(position, scene.domain, [not wraps for wraps in scene.periodic]) > 0


_CROWDING_EVERY = 16  # bundles: its sum over particles costs as much as all the rest
_READ_EVERY = 16  # bundles, where reading measures back halts the device
_LEAST_CROWDING = 3.0  # models of data that hardly compress (SPH) crowd cells of their own scenes 2.5 times
_AT_WALLS, _CROWDING_LIMIT, _RESTING = "particles at the walls", "crowding limit", "at rest"


_UNITS = {"speed": "{:.3g} cells per frame", "energy": "{:+.1%}", "crowding": "{:.3g} cells' volume in one cell"}
"""How measures are printed."""


class Policy(Enum):
    """Reaction of a monitor to a limit that is exceeded."""

    WARN = "warn"
    STOP = "stop"
    RECORD = "record"


class RolloutStoppedError(NmpmError):
    """A rollout exceeded a limit of its monitor; the frames predicted until then have been yielded."""


@dataclass(frozen=True)
class Incident:
    """A limit exceeded for the first time in a rollout, by the last frame of a bundle, from 1, in a scene of the batch.

    `what` is "speed", "energy", "crowding" or "not finite".
    """

    what: str
    frame: int
    scene: int
    value: float
    limit: float

    def __str__(self) -> str:
        where = f"in scene {self.scene} by frame {self.frame}"
        if self.what not in _UNITS:
            return f"{self.what} {where}"
        value, limit = (_UNITS[self.what].format(number) for number in (self.value, self.limit))
        return f"{self.what} {value} (limit {limit.split()[0]}) {where}"


@dataclass
class Monitor:
    """Limits that a rollout is watched for, once per bundle; on other devices than a CPU read every 16 bundles.

    Args:
        policy: To warn, once for each kind of incident, to stop, or only to record.
        speed: Largest step of a particle along an axis, in the last frame of a bundle, in the narrowest cells.
        energy_gain: Largest share of the first state's energy that may be gained; not watched where gravity is unknown,
            obstacles move, axes are open, or particles enter.
        crowding: Largest volume fraction of a cell, measured every 16th bundle; the largest that the network is shown,
            but at least 3, when left out.
        first_scene: Number of the batch's first scene, in incidents.

    Attributes:
        incidents: The first of each kind in this rollout.
        peaks: The largest value of each measure in this rollout, by the names that incidents have.
        at_walls: Particles at the scene's walls or beyond, when crowding was last measured.
        rest_share: Mean share of the particles that a bundle leaves where they were, as `rest_speed` does.
        trust: A sentence about the last trusted frame; empty where members are not watched, see `nmpm.emulator.trust`.
    """

    policy: Policy = Policy.WARN
    speed: float = 4.0
    energy_gain: float = MOST_GAIN
    crowding: float | None = None
    first_scene: int = 0
    incidents: list[Incident] = field(default_factory=list)
    peaks: dict[str, float] = field(default_factory=dict)
    at_walls: int = 0
    rest_share: float = 0.0
    trust: str = ""
    _frames: int = 0
    _last_frame: float = math.inf
    _bundles: int = 0
    _judged: int = 0
    _padded: bool = False
    _reference: tuple[Tensor, Tensor, Tensor] | None = None
    """The first state's energy (B,), how far it is above the lowest possible (B,), and the mass shares (B, N, 1)."""
    _unread: list[tuple[int, dict[str, Tensor]]] = field(default_factory=list)

    def start(self, emulator: Emulator, particles: Particles, frames: int | None = None) -> None:
        """Reset, for a rollout of so many frames, or of whole bundles, from a state."""
        self._last_frame = math.inf if frames is None else frames
        self.incidents, self.peaks, self.at_walls, self._frames, self._bundles = [], {}, 0, 0, 0
        self.rest_share, self._judged, self.trust = 0.0, 0, ""
        self._unread = []
        self._padded = not is_eager_cpu(particles.mask) or not bool(particles.mask.all())
        if not emulator.scene.gravity_known or not emulator.scene.is_closed:
            self._reference = None
            return
        share = mass_shares(emulator.scene, particles.material, particles.present_volume, particles.position.dtype)
        begun = energy(particles.position, particles.velocity, particles.gravity.unsqueeze(1), share)
        above = begun - lowest_potential(emulator.scene, particles.gravity)
        self._reference = begun, above.clamp(min=torch.finfo(begun.dtype).tiny), share

    def ignore_energy(self) -> None:
        """Of the rollout that starts, do not watch the energy: particles enter or leave, or obstacles move."""
        self._reference, self._padded = None, True

    def see(self, emulator: Emulator, particles: Particles, bundle: Bundle) -> None:
        """Measure a bundle that the emulator predicted from a state; raises RolloutStoppedError, see `Policy`."""
        self._frames = int(min(self._frames + bundle.position.shape[1], self._last_frame))
        self._bundles += 1
        if not particles.position.shape[1]:
            return
        measures = self._measures(emulator, particles, bundle)
        if self._bundles % _CROWDING_EVERY == 1:
            measures |= self._crowding_and_walls(emulator, particles, bundle.position[:, -1])
        self._unread.append((self._frames, measures))
        if is_eager_cpu(bundle.position) or len(self._unread) == _READ_EVERY:
            self.read()

    def read(self) -> None:
        """Read the measures that are still on the device, in one transfer; raises as `see`."""
        unread, self._unread = self._unread, []
        if not unread:
            return
        rows = [values for _, measures in unread for values in measures.values()]
        read = iter(torch.stack(rows).cpu())
        for frame, measures in unread:
            self._judge(frame, {name: next(read) for name in measures})

    def _measures(self, emulator: Emulator, particles: Particles, bundle: Bundle) -> dict[str, Tensor]:
        """(B,) measures of a bundle by name."""
        moving = bundle.velocity
        if self._padded:
            moving = moving.masked_fill(~particles.mask.unsqueeze(-1), 0.0)
        # A NaN position makes the last velocity NaN, and with it the largest, so checking that suffices.
        resting = (bundle.position[:, -1] == particles.position).all(-1) & particles.mask
        measures = {_RESTING: (resting.sum(1) / particles.mask.sum(1).clamp(min=1)).to(bundle.velocity)}
        measures |= {"speed": moving.abs().amax((1, 2)) / min(emulator.grid.spacing)}
        if self._reference is not None:
            begun, above_lowest, share = self._reference
            now = energy(bundle.position[:, -1], bundle.velocity, particles.gravity.unsqueeze(1), share)
            measures["energy"] = (now - begun) / above_lowest
        return measures

    def _crowding_and_walls(self, emulator: Emulator, particles: Particles, last: Tensor) -> dict[str, Tensor]:
        """(B,) measures of positions (B, N, D) by name."""
        grid, scene = emulator.grid, emulator.scene
        volume, cells = particles.present_volume, grid.to_cells(last.nan_to_num())
        fraction = volume_fraction(scene, grid, emulator.transfer, volume, cells)
        at_walls = (distance_beyond(last, scene.bounds, scene.confined) >= 0) & particles.mask
        measures = {"crowding": fraction.flatten(1).amax(1).to(last), _AT_WALLS: at_walls.sum(1).to(last)}
        if self.crowding is None:
            first, count = scene.input_channels.index(f"{scene.materials[0]}.volume"), len(scene.materials)
            limit = emulator.input_high[first : first + count].amax().clamp(min=_LEAST_CROWDING)
            measures[_CROWDING_LIMIT] = limit.to(last).expand(len(last))
        return measures

    def _judge(self, frame: int, measures: Mapping[str, Tensor]) -> None:
        """Take in the (B,) measures of the bundle that ends with a frame, on the CPU."""
        self._judged += 1
        self.rest_share += (float(measures[_RESTING].mean()) - self.rest_share) / self._judged
        speed = measures["speed"]
        if not math.isfinite(float(speed.max())):
            self._note("not finite", frame, (~speed.isfinite()).float(), 0.0)
        self._note("speed", frame, speed, self.speed)
        if "energy" in measures:
            self._note("energy", frame, measures["energy"], self.energy_gain)
        if "crowding" in measures:
            limit = float(measures[_CROWDING_LIMIT][0]) if self.crowding is None else self.crowding
            self._note("crowding", frame, measures["crowding"], limit)
            self.at_walls = int(measures[_AT_WALLS].sum())

    def _note(self, what: str, frame: int, values: Tensor, limit: float) -> None:
        """Take in a (B,) measure."""
        worst = float(values.max())
        self.peaks[what] = max(self.peaks.get(what, -math.inf), worst)
        if not worst > limit or any(incident.what == what for incident in self.incidents):
            return
        incident = Incident(what, frame, self.first_scene + int(values.argmax()), worst, limit)
        self.incidents.append(incident)
        if self.policy is Policy.STOP:
            raise RolloutStoppedError(f"The rollout was stopped: {incident}. {self.report()}")
        if self.policy is Policy.WARN:
            warnings.warn(f"The rollout exceeded a limit: {incident}.", stacklevel=6)

    def gather(self, parts: Sequence[Monitor]) -> None:
        """Adopt what monitors of the parts of a batch, of about as many scenes each, have measured."""
        first: dict[str, Incident] = {}
        for incident in sorted((one for part in parts for one in part.incidents), key=lambda one: one.frame):
            first.setdefault(incident.what, incident)
        self.incidents = list(first.values())
        names = dict.fromkeys(name for part in parts for name in part.peaks)
        self.peaks = {name: max(part.peaks.get(name, -math.inf) for part in parts) for name in names}
        self._frames = max((part._frames for part in parts), default=0)
        self.at_walls = sum(part.at_walls for part in parts)
        self.rest_share = sum(part.rest_share for part in parts) / max(1, len(parts))

    def report(self) -> str:
        """A summary of the rollout in a sentence or two."""
        seen = ", ".join(_peak(what, value) for what, value in self.peaks.items() if what in _UNITS)
        exceeded = "; ".join(map(str, self.incidents)) or "none"
        still = f"{self.at_walls} particles at the walls, {self.rest_share:.0%} of all at rest on average"
        trust = f" {self.trust}" if self.trust else ""
        return f"{self._frames} frames. At most: {seen}; {still}. Limits exceeded: {exceeded}.{trust}"


def _peak(what: str, value: float) -> str:
    """A measure's largest value in words."""
    if what == "energy" and value < 5e-4:  # which would be printed as +0.0%, or as a negative gain
        return "energy never above the start's"
    return f"{what} {_UNITS[what].format(value)}"
