"""Particles as tensors: the state a rollout carries, the window a training step sees, and states to start from.

Shapes, once for the whole package: B scenes in a batch, N particles (padded to the largest scene), M static
particles (likewise), D space dimensions, T frames. Positions are in domain length, velocities in length per frame
(v_t = p_t - p_{t-1}), gravity in length per frame squared. Fields are further numbers by name, in units of their own:
one for each particle, such as a temperature, or one for each scene, such as a friction angle.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from nmpm.scene import Interval, Scene

_SHARED = ("material", "mask", "obstacle", "obstacle_mask", "gravity", "obstacle_share", "volume")
"""What particles and windows both have, unchanged."""


class Batched:
    """Dataclasses of tensors (B, …) of the same B scenes, which are moved, converted and picked together."""

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Self:
        """The same on another device; `non_blocking` copies from pinned memory to a GPU do not block the host."""
        return self.map(lambda values: values.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Self:
        """The same in page-locked host memory, from which a GPU copies asynchronously."""
        return self.map(Tensor.pin_memory)

    def double(self) -> Self:
        """The same in float64; indices and masks keep their types."""
        return self.map(lambda values: values.double() if values.is_floating_point() else values)

    def scenes(self, chosen: slice | list[int]) -> Self:
        """Some of the scenes, (B', …): views of the tensors for a slice; the padding is that of the whole batch."""
        return self.map(lambda values: values[chosen])

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same with a function applied to each tensor, those of fields among them."""
        changed: dict[str, Any] = {name: change(own) for name, own in vars(self).items() if isinstance(own, Tensor)}
        changed["fields"] = {name: change(values) for name, values in vars(self)["fields"].items()}
        return type(self)(**changed)


@dataclass(frozen=True)
class Particles(Batched):
    """The state of B scenes at one frame.

    Args:
        position: (B, N, D) in domain length.
        velocity: (B, N, D) in length per frame.
        material: (B, N) int64, index into `Scene.materials`.
        mask: (B, N) bool, False for padding, which changes nothing.
        obstacle: (B, M, D) positions of particles that do not move; M may be 0.
        obstacle_mask: (B, M) bool, False for padding.
        gravity: (B, D) in length per frame squared; zero where unknown.
        fields: By name, (B, N) values of the particles, or (B, 1) where each scene has one value.
        obstacle_velocity: (B, M, D) in length per frame; None where no obstacle moves.
        volume: (B, N) volume of each particle as a multiple of the scene's `particle_volume`; None for 1.
        obstacle_share: (B, M) how much of a particle's volume each obstacle particle stands for; None for all of it.
            Bodies that are rasterised softly (`nmpm.emulator.bodies`) have shares, and gradients through them.

    Attributes:
        budget: (B,) energy per mass of the first state of the rollout that led here, which the frames after this one
            may not exceed either, in length² per frame² from the domain's lower corner; None for this state's own.
            A state that is made of this one by `replace` or `with_motion` has its own.

    Raises:
        ValueError: if the shapes do not fit together.
    """

    position: Tensor
    velocity: Tensor
    material: Tensor
    mask: Tensor
    obstacle: Tensor
    obstacle_mask: Tensor
    gravity: Tensor
    fields: Mapping[str, Tensor] = field(default_factory=dict)
    obstacle_share: Tensor | None = None
    obstacle_velocity: Tensor | None = None
    volume: Tensor | None = None
    budget: Tensor | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        batch, count, dim = self.position.shape
        _check_shapes(self, batch, count, dim, [(batch, count), (batch, 1)])
        _check_shape("Particles.velocity", self.velocity, [(batch, count, dim)])
        if self.obstacle_velocity is not None:
            _check_shape("Particles.obstacle_velocity", self.obstacle_velocity, [tuple(self.obstacle.shape)])

    @classmethod
    def stack(cls, states: Sequence[Particles]) -> Particles:
        """The scenes of several states, at least one, padded to the largest: scene b's own particles are `mask[b]`.

        Raises:
            ValueError: if some have fields, volumes, shares or velocities of obstacles that others lack.
        """
        plain = [state.with_budget(None) for state in states]
        tensors = [{name: v for name, v in vars(state).items() if isinstance(v, Tensor)} for state in plain]
        for kind, have in (("tensors", tensors), ("fields", [state.fields for state in states])):
            if differ := set[str]().union(*have).difference(set(have[0]).intersection(*have)):
                raise ValueError(f"Not all of the states to stack have the {kind} {', '.join(sorted(differ))}.")
        fields = {name: _stacked([state.fields[name] for state in states]) for name in states[0].fields}
        stacked = cls(**{name: _stacked([each[name] for each in tensors]) for name in tensors[0]}, fields=fields)
        budgets = [state.budget for state in states if state.budget is not None]
        return stacked.with_budget(torch.cat(budgets) if len(budgets) == len(states) else None)

    @property
    def present_volume(self) -> Tensor:
        """(B, N) volume of each particle as a multiple of the scene's, 0 for padding; the mask where all are alike."""
        return self.mask if self.volume is None else self.volume * self.mask

    def with_motion(self, position: Tensor, velocity: Tensor) -> Particles:
        """The same particles elsewhere: (B, N, D) positions and velocities."""
        return dataclasses.replace(self, position=position, velocity=velocity)

    def map(self, change: Callable[[Tensor], Tensor]) -> Particles:
        if self.budget is None:
            return super().map(change)
        return self.with_budget(None).map(change).with_budget(change(self.budget))

    def with_budget(self, budget: Tensor | None) -> Particles:
        """The same state with an energy (B,) that rollouts from it may have, see `budget`."""
        if budget is self.budget:
            return self
        same = copy.copy(self)
        object.__setattr__(same, "budget", budget)
        return same

    def with_padding_at(self, point: Sequence[float]) -> Particles:
        """The same state with its padding at rest at a point (D,), whatever it held: NaN times 0 is NaN.

        Without padding, on a CPU, the state itself.
        """
        if self.mask.device.type == "cpu" and bool(self.mask.all()) and bool(self.obstacle_mask.all()):
            return self
        real, solid, at = self.mask, self.obstacle_mask, self.position.new_tensor(point)
        moved, share = self.obstacle_velocity, self.obstacle_share
        fields = {name: v if v.shape[1] != real.shape[1] else v.where(real, 0.0) for name, v in self.fields.items()}
        return dataclasses.replace(
            self,
            position=self.position.where(real.unsqueeze(-1), at),
            velocity=self.velocity.where(real.unsqueeze(-1), 0.0),
            material=self.material.where(real, 0),
            obstacle=self.obstacle.where(solid.unsqueeze(-1), at.to(self.obstacle)),
            fields=fields,
            volume=None if self.volume is None else self.volume.where(real, 1.0),
            obstacle_share=None if share is None else share.where(solid, 0.0),
            obstacle_velocity=None if moved is None else moved.where(solid.unsqueeze(-1), 0.0),
        ).with_budget(self.budget)

    def with_fields(self, fields: Mapping[str, Tensor]) -> Particles:
        """The same particles with some fields replaced or added: (B, N) or (B, 1) by name."""
        return dataclasses.replace(self, fields={**self.fields, **fields})


@dataclass  # (not frozen: Lightning assigns the tensors that it has converted to another precision)
class Window(Batched):
    """Consecutive recorded frames of B scenes: two to start from, the rest to predict.

    Args:
        frames: (B, T, N, D) positions in domain length, T >= 2; finite also where a particle is absent.
        material, mask, obstacle, obstacle_mask, gravity, obstacle_share, volume: as in `Particles`.
        fields: By name, (B, T, N) values of the particles, or (B, 1, N) if they are constant in time, or (B, 1, 1)
            where each scene has one value.
        present: (B, T, N) bool, whether each particle is there in each frame; None where all of `mask` always are.
        obstacle_frames: (B, T, M, D) positions of obstacles in each frame; None where no obstacle moves. `obstacle`
            has those of the second frame.
        observed: (B, T) bool, whether each frame was recorded; the others are interpolated and count in no error. None
            where all were. The second frame always was. The same in all scenes.

    Raises:
        ValueError: if the shapes do not fit together.
    """

    frames: Tensor
    material: Tensor
    mask: Tensor
    obstacle: Tensor
    obstacle_mask: Tensor
    gravity: Tensor
    fields: Mapping[str, Tensor] = field(default_factory=dict)
    obstacle_share: Tensor | None = None
    present: Tensor | None = None
    obstacle_frames: Tensor | None = None
    volume: Tensor | None = None
    observed: Tensor | None = None

    def __post_init__(self) -> None:
        batch, frames, count, dim = self.frames.shape
        if frames < 2:
            raise ValueError(f"A window needs at least 2 frames, for a velocity; it has {frames}.")
        _check_shapes(self, batch, count, dim, [(batch, frames, count), (batch, 1, count), (batch, 1, 1)])
        if self.present is not None:
            _check_shape("Window.present", self.present, [(batch, frames, count)])
        if self.obstacle_frames is not None:
            _check_shape("Window.obstacle_frames", self.obstacle_frames, [(batch, frames, *self.obstacle.shape[1:])])
        if self.observed is not None:
            _check_shape("Window.observed", self.observed, [(batch, frames)])

    @classmethod
    def of(cls, state: Particles) -> Self:
        """The two frames (B, 2, N, D) of a state, and none to predict."""
        frames = torch.stack([state.position - state.velocity, state.position], dim=1)
        fields = {name: values.unsqueeze(1) for name, values in state.fields.items()}
        return cls(frames=frames, fields=fields, **{name: getattr(state, name) for name in _SHARED})

    @property
    def initial(self) -> Particles:
        """The state at the window's second frame, of the particles that are there in the first two."""
        moved = self.obstacle_frames
        there = self.mask if self.present is None else self.mask & self.present[:, 0] & self.present[:, 1]
        return Particles(
            position=self.frames[:, 1],
            velocity=self.frames[:, 1] - self.frames[:, 0],
            fields={name: values[:, min(1, values.shape[1] - 1)] for name, values in self.fields.items()},
            obstacle_velocity=None if moved is None else moved[:, 1] - moved[:, 0],
            **({name: getattr(self, name) for name in _SHARED} | {"mask": there}),
        )

    def mask_at(self, frame: int) -> Tensor:
        """(B, N) bool, which particles are there in a frame."""
        return self.mask if self.present is None else self.mask & self.present[:, frame]

    def volume_at(self, frame: int) -> Tensor:
        """(B, N) volume of each particle in a frame, as `Particles.present_volume`."""
        there = self.mask_at(frame)
        return there if self.volume is None else self.volume * there

    def first(self, frames: int) -> Self:
        """The first frames, two or more."""
        return self.pick_frames(slice(frames))

    def pick_frames(self, picked: slice | list[int]) -> Self:
        """Some of the frames, two or more."""
        timed = {name: getattr(self, name) for name in ("frames", "present", "obstacle_frames", "observed")}
        cut: dict[str, Any] = {name: values[:, picked] for name, values in timed.items() if values is not None}
        cut["fields"] = {name: v if v.shape[1] == 1 else v[:, picked] for name, v in self.fields.items()}
        return dataclasses.replace(self, **cut)

    def padded(self, multiple: int) -> Self:
        """The windows with as much padding as makes N and M multiples of a number, so that shapes repeat."""
        particles = {"frames": 2, "material": 1, "mask": 1, "present": 2, "volume": 1}
        obstacles = {"obstacle": 1, "obstacle_mask": 1, "obstacle_share": 1, "obstacle_frames": 2}
        larger: dict[str, Any] = {
            name: _extended(getattr(self, name), axis, -getattr(self, name).shape[axis] % multiple)
            for name, axis in (particles | obstacles).items()
            if getattr(self, name) is not None
        }
        count = self.frames.shape[2]
        larger["fields"] = {
            name: _extended(v, 2, -count % multiple if v.shape[2] == count else 0) for name, v in self.fields.items()
        }
        return dataclasses.replace(self, **larger)

    @property
    def recorded(self) -> Tensor:
        """The frames, (B, T, N, D), NaN where a particle is absent; those that were not observed are interpolated."""
        return self.frames if self.present is None else self.frames.where(self.present.unsqueeze(-1), torch.nan)

    @property
    def target(self) -> Tensor:
        """The frames to predict, (B, T - 2, N, D)."""
        return self.frames[:, 2:]

    @property
    def observed_targets(self) -> list[int]:
        """Indices of the frames to predict that were observed."""
        count = self.frames.shape[1] - 2
        return list(range(count)) if self.observed is None else self.observed[:, 2:].all(0).nonzero()[:, 0].tolist()

    def at_observed(self) -> Self:
        """The frames that were observed, as a window of the data's frames; its start has the same velocity."""
        if self.observed is None:
            return self
        picked = self.observed_targets
        between, window = picked[0] + 1 if picked else 1, self.pick_frames([0, 1, *(frame + 2 for frame in picked)])
        for frames in (window.frames, window.obstacle_frames):
            if frames is not None:
                frames[:, 0] = frames[:, 1] - between * (frames[:, 1] - frames[:, 0])
        return dataclasses.replace(window, gravity=between**2 * self.gravity, observed=None)

    def field_target(self, name: str) -> Tensor:
        """A field at the frames to predict, (B, T - 2, N)."""
        values = self.fields[name]
        ahead = values if values.shape[1] == 1 else values[:, 2:]
        return ahead.expand(-1, self.frames.shape[1] - 2, self.frames.shape[2])


def _extended(values: Tensor, axis: int, by: int) -> Tensor:
    """Values with the first along an axis, if there is one, repeated at its end so many times; False in a mask."""
    if not by:
        return values
    shape = [by if at == axis else extent for at, extent in enumerate(values.shape)]
    blank = values.dtype == torch.bool or not values.shape[axis]
    more = values.new_zeros(shape) if blank else values.narrow(axis, 0, 1).expand(shape)
    return torch.cat([values, more], dim=axis)


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    """Tensors (B, K, …) along the first axis, extended to the largest along the second."""
    most = max(values.shape[1] for values in parts)
    return torch.cat([_extended(values, 1, most - values.shape[1]) for values in parts])


def scene_volumes(volume: Tensor | None, mask: Tensor) -> Tensor | None:
    """(B,) volume of each scene's particles, of (B, N) volumes; None where those of one scene differ.

    Reads a value back from the device.
    """
    if volume is None:
        return mask.new_ones(mask.shape[0], dtype=torch.get_default_dtype())
    of_scene = torch.where(mask, volume, 0.0).amax(1) if mask.shape[1] else volume.new_ones(len(volume))
    return of_scene if bool(((volume == of_scene.unsqueeze(1)) | ~mask).all()) else None


def _check_shapes(owner: Particles | Window, batch: int, count: int, dim: int, fields: list[tuple[int, ...]]) -> None:
    statics = owner.obstacle.shape[1]
    expected = {
        "material": (batch, count),
        "mask": (batch, count),
        "obstacle": (batch, statics, dim),
        "obstacle_mask": (batch, statics),
        "gravity": (batch, dim),
        "volume": (batch, count),
        "obstacle_share": (batch, statics),
    }
    kind = type(owner).__name__
    for name, shape in expected.items():
        if (values := getattr(owner, name)) is not None:
            _check_shape(f"{kind}.{name}", values, [shape])
    for name, values in owner.fields.items():
        _check_shape(f"{kind}.fields[{name!r}]", values, fields)


def _check_shape(name: str, values: Tensor, allowed: list[tuple[int, ...]]) -> None:
    if tuple(values.shape) not in allowed:
        raise ValueError(f"{name} has shape {tuple(values.shape)}, expected {' or '.join(map(str, allowed))}.")


def thrown_blocks(scene: Scene, count: int = 1000, blocks: int = 1, speed: float = 1.0, seed: int = 0) -> Particles:
    """Square blocks (cubes) of particles on a lattice at the scene's own density, side by side along the first axis.

    About `count` particles in all, of the scene's materials in turn, with random velocities up to `speed` in length per
    second along each axis: one scene (B = 1) without obstacles.

    Raises:
        ValueError: if the blocks do not fit into the box.
    """
    rng = np.random.default_rng(seed)
    spacing = scene.particle_spacing
    side = max(1, round((count / blocks) ** (1 / scene.dim)))
    low, high = np.array(scene.bounds).T
    room = (high - low) / np.array([blocks] + [1] * (scene.dim - 1)) - side * spacing
    if room.min() < 0:
        raise ValueError(
            f"{blocks} blocks of {side**scene.dim} particles, {side * spacing:.3g} wide, overfill the box."
        )
    nodes = np.indices((side,) * scene.dim).reshape(scene.dim, -1).T
    lattice = spacing * (nodes + 0.5)
    shift = np.eye(scene.dim)[0] * (high - low)[0] / blocks
    corners = low + rng.uniform(0, room, (blocks, scene.dim)) + np.arange(blocks)[:, None] * shift
    position = torch.from_numpy((corners[:, None] + lattice).reshape(1, -1, scene.dim)).float()
    thrown = np.repeat(rng.uniform(-speed, speed, (blocks, scene.dim)) * scene.dt, len(lattice), axis=0)
    material = torch.arange(blocks).remainder(len(scene.materials)).repeat_interleave(len(lattice))[None]
    return _state(scene, position, torch.from_numpy(thrown[None]).float(), material)


def lattice(box: Sequence[Interval], spacing: float) -> Tensor:
    """(N, D) points that fill a box, about `spacing` apart, in domain length."""
    numbers = [max(1, round((high - low) / spacing)) for low, high in box]
    axes = [
        low + (high - low) * (torch.arange(n, dtype=torch.float64) + 0.5) / n
        for (low, high), n in zip(box, numbers, strict=True)
    ]
    return torch.cartesian_prod(*axes).reshape(-1, len(axes)).float()


def state_at_rest(scene: Scene, position: Tensor, obstacle: Tensor | None = None) -> Particles:
    """Particles (N, D) of the first material at rest, and perhaps obstacle particles (M, D): one scene (B = 1)."""
    material = torch.zeros(1, len(position), dtype=torch.int64)
    return _state(scene, position[None], torch.zeros_like(position)[None], material, obstacle)


def _state(
    scene: Scene, position: Tensor, velocity: Tensor, material: Tensor, obstacle: Tensor | None = None
) -> Particles:
    solid = position.new_zeros(1, 0, scene.dim) if obstacle is None else obstacle[None]
    return Particles(
        position=position,
        velocity=velocity,
        material=material,
        mask=torch.ones_like(material, dtype=torch.bool),
        obstacle=solid,
        obstacle_mask=torch.ones(1, solid.shape[1], dtype=torch.bool),
        gravity=torch.tensor(scene.gravity or (0.0,) * scene.dim)[None] * scene.dt**2,
    )
