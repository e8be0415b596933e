"""States to start a rollout from: of plain arrays, checked for mistakes; thrown blocks; recorded frames."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from nmpm._support.messages import one_line, suggestion
from nmpm._support.plain_data import check_whole
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.statistics import displacements
from nmpm.data.volumes import relative_volumes
from nmpm.data.windows import model_velocity
from nmpm.emulator.bodies import sample_bodies
from nmpm.emulator.calibration import calibrated_range, gravity_range, with_usual_gravity
from nmpm.emulator.engines.torch.contact import Contact, obstacle_share
from nmpm.emulator.fields import warn_of_ignored
from nmpm.emulator.model import Emulator
from nmpm.emulator.monitor import check_inputs
from nmpm.errors import ConfigError, DataError
from nmpm.obstacles import Body
from nmpm.particles import Particles, thrown_blocks
from nmpm.scene import Scene

Bodies = Sequence[Body] | Sequence[Sequence[Body]]
"""Obstacles of all scenes, or of each."""

TOO_FAST = 2.0
"""Speeds above this multiple of the calibrated range are errors, unless the data have been compared with the model."""
SUSPICIOUSLY_SLOW = 0.005
"""If no speed exceeds this fraction of the calibrated range, but speeds per frame would be within it, a warning."""
FINE = 2e-4
"""Cells between float32 numbers beyond which states are in float64."""
_COARSE = 1e-3  # cells between numbers of the positions' type: a warning


class StateBuilder:
    """Builds a model's states from arrays; shapes and units are those of `Pretrained.state`.

    Args:
        emulator: Gives the scene, and the range of velocities and gravity that it was calibrated for.
        position: (N, D) or (B, N, D).
        dtype: Floating-point type of the state; if None, float32, or float64 in domains too far from the origin.
        too_fast: Speeds above this multiple of the calibrated range are errors.

    Raises:
        DataError: if the positions have another shape.
    """

    def __init__(
        self, emulator: Emulator, position: Any, dtype: torch.dtype | None, too_fast: float = TOO_FAST
    ) -> None:
        self.emulator, self.scene, self.too_fast = emulator, emulator.scene, too_fast
        single = emulator.device.type == "mps" or emulator.grid.resolves(torch.float32, FINE)
        self.dtype = dtype or (torch.float32 if single else torch.float64)
        points = _numbers("position", position)
        self._coarsest = max(self.dtype, _precision(position), key=lambda each: torch.finfo(each).eps)
        dim = self.scene.dim
        if points.dim() not in (2, 3) or points.shape[-1] != dim or not points.numel():
            raise DataError(
                f"position has the shape {tuple(points.shape)}; it must be (N, {dim}) or (B, N, {dim}) for this model's"
                f" {dim}-D scenes, with at least one particle."
            )
        self.position = points.reshape(-1, *points.shape[-2:])
        self.batch, self.count = self.position.shape[:2]

    def build(
        self,
        velocity: Any,
        material: Any,
        obstacle: Any,
        gravity: Any,
        fields: Mapping[str, Any] | None,
        bodies: Bodies | None,
        volume: Any = None,
    ) -> Particles:
        """The state, with velocities and gravity converted to frames; raises as `Pretrained.state`."""
        self._check_precision()
        solid, share = self._obstacle(obstacle), None
        if bodies:
            solid, share = self._add_bodies(solid, bodies)
        kind, speed = self._material(material), self._velocity(velocity)
        state = Particles(
            position=self.position.to(self.dtype),
            velocity=(speed * self.scene.dt).to(self.dtype),
            material=kind,
            mask=torch.ones_like(kind, dtype=torch.bool),
            obstacle=solid.to(self.dtype),
            obstacle_mask=torch.ones(solid.shape[:2], dtype=torch.bool, device=solid.device),
            gravity=self.gravity(gravity),
            fields=self._fields(fields or {}),
            obstacle_share=share,
            volume=None if volume is None else self._volume(volume),
        )
        check_inputs(self.emulator, state)
        self._check_speeds(speed, kind)
        self._check_obstacles(state)
        return state

    def _check_precision(self) -> None:
        """Warn of positions of a type that is coarse at the domain's ends; a DataError if it is useless there."""
        grid = self.emulator.grid
        grid.check_precision(self._coarsest)
        if not grid.resolves(self._coarsest, _COARSE):
            name = str(self._coarsest).removeprefix("torch.")
            corner = ", ".join(f"{low:.9g}" for low in grid.lower)
            warnings.warn(
                f"Positions are {name}, whose numbers are up to {grid.rounding(self._coarsest):.2g} cells apart in this"
                f" domain. Give float64 ones, or subtract ({corner}) in float64 from positions, bounds and domain.",
                stacklevel=4,
            )

    def _fields(self, given: Mapping[str, Any]) -> dict[str, Tensor]:
        """The fields of the scene, (B, N) or (B, 1)."""
        warn_of_ignored(self.scene, given)
        fields: dict[str, Tensor] = {}
        for name in (name for name in self.scene.fields if name in given):
            count = 1 if name in self.scene.parameters else self.count
            values = _numbers(name, given[name])
            if count == 1 and tuple(values.shape) == (self.batch,):
                values = values.unsqueeze(1)
            shape = (self.batch, count)
            fields[name] = self._expand(name, values, [(), shape[1:], shape], shape).to(self.dtype)
        return fields

    def _volume(self, given: Any) -> Tensor:
        """(B, N) multiples of the scene's particle volume."""
        shape = (self.batch, self.count)
        values = self._expand("volume", given, [(), shape[1:], shape], shape)
        if not bool((values > 0).all()):
            scene, particle = map(int, (~(values > 0)).nonzero()[0])
            raise DataError(
                f"Scene {scene}, particle {particle}: volume = {float(values[scene, particle]):g} must be positive: a"
                f" multiple of scene.particle_volume, {self.scene.particle_volume:g}."
            )
        return values.to(self.dtype)

    def _velocity(self, given: Any) -> Tensor:
        shape = (self.batch, self.count, self.scene.dim)
        if given is None:
            return torch.zeros_like(self.position)
        return self._expand("velocity", given, [shape[2:], shape[1:], shape], shape)

    def _material(self, given: Any) -> Tensor:
        materials, shape = self.scene.materials, (self.batch, self.count)
        if given is None:
            if len(materials) > 1:
                raise DataError(f"material is needed, as the model has several: {', '.join(materials)}.")
            given = materials[0]
        if not isinstance(given, Tensor):
            names = np.asarray(given)
            if names.dtype.kind in "UO":
                given = np.vectorize(self._index_of, otypes=[np.int64])(names)
        indices = self._expand("material", given, [(), shape[1:], shape], shape)
        wrong = (indices != indices.round()) | (indices < 0) | (indices >= len(materials))
        if wrong.any():
            scene, particle = map(int, wrong.nonzero()[0])
            raise DataError(
                f"Scene {scene}, particle {particle}: material {indices[scene, particle]:g} is not an index into"
                f" {list(materials)}. Type ids of datasets are not indices: give names, such as {materials[0]!r}."
            )
        return indices.long().contiguous()

    def _index_of(self, name: object) -> int:
        if name not in self.scene.materials:
            raise DataError(
                f"Material {one_line(repr(name), 60)} is unknown to this model, which has"
                f" {', '.join(self.scene.materials)}.{suggestion(str(name)[:60], self.scene.materials)}"
            )
        return self.scene.materials.index(str(name))

    def _obstacle(self, given: Any) -> Tensor:
        dim = self.scene.dim
        if given is None:
            return self.position.new_zeros(self.batch, 0, dim)
        if not self.scene.obstacles:
            raise DataError("obstacle: the model was trained without obstacles and would not see them; leave it out.")
        points = _numbers("obstacle", given)
        count = points.shape[-2] if points.dim() > 1 else 0
        shape = (self.batch, count, dim)
        return self._expand("obstacle", points, [shape[1:], shape], shape)

    def _add_bodies(self, solid: Tensor, given: Bodies) -> tuple[Tensor, Tensor]:
        """(B, M, D) obstacle particles with those of bodies, and their shares (B, M)."""
        if not self.scene.obstacles:
            raise DataError("bodies: the model was trained without obstacles and would not see them; leave them out.")
        common = all(isinstance(body, Body) for body in given)
        if not common and (len(given) != self.batch or any(isinstance(bodies, Body) for bodies in given)):
            raise DataError(
                f"bodies: give one list of bodies for all scenes, or a list of such lists, one for each of {self.batch}"
                f" scenes; this one has {len(given)} entries."
            )
        scenes = cast("Sequence[Sequence[Body]]", [given] if common else given)
        points, share = sample_bodies(scenes, self.scene, self.emulator.grid)
        share = share.expand(self.batch, -1)
        whole = share.new_ones(solid.shape[:2])
        joined = torch.cat([solid, points.expand(self.batch, *points.shape).to(solid)], dim=1)
        return joined, torch.cat([whole, share], dim=1).to(self.dtype)

    def gravity(self, given: Any) -> Tensor:
        """(B, D) in length per frame squared, from (D,) or (B, D) in length/s²; None for the scene's.

        Raises:
            DataError: if it is not the model's, or needed.
        """
        scene, shape = self.scene, (self.batch, self.scene.dim)
        if given is None and scene.gravity_varies and scene.gravity is None:
            raise DataError("gravity is needed, in length/s²: this model's scenes differ in it.")
        stated = scene.gravity or (0.0,) * scene.dim
        values = self._expand("gravity", stated if given is None else given, [shape[1:], shape], shape)
        if not values.isfinite().all():
            raise DataError(f"gravity = {values.tolist()} must be finite.")
        if given is not None and scene.gravity_varies:
            self._check_gravity_range(values)
        elif given is not None:
            self._check_fixed_gravity(values)
        return (values * scene.dt**2).to(self.dtype)

    def _check_fixed_gravity(self, values: Tensor) -> None:
        if self.scene.gravity is None:
            raise DataError("gravity: it is not known for this model's scenes, so none can be set; leave it out.")
        fixed = values.new_tensor(self.scene.gravity)
        largest = float(fixed.abs().max())
        if (values - fixed).abs().max() <= 1e-3 * largest:
            return
        per_frame = (values / self.scene.dt**2 - fixed).abs().max() <= 1e-2 * largest
        hint = " It seems to be per frame squared: divide it by dt²." if per_frame and largest else ""
        raise DataError(
            f"gravity = {values[0].tolist()} length/s², but the model knows only {list(self.scene.gravity)}, with which"
            f" it was trained; leave it out.{hint}"
        )

    def _check_gravity_range(self, values: Tensor) -> None:
        low, high = gravity_range(self.emulator)
        outside = (values < low - 0.01 * low.abs()) | (values > high + 0.01 * high.abs())
        if outside.any():
            scene = int(outside.any(-1).nonzero()[0])
            raise DataError(
                f"Scene {scene}: gravity = {values[scene].tolist()} length/s² is outside of the range that the model"
                f" was calibrated for, {_format(low)} … {_format(high)}."
            )

    def _check_speeds(self, velocity: Tensor, material: Tensor) -> None:
        """Compare velocities (B, N, D) in length/s with the range that the network was calibrated for."""
        ranges = [calibrated_range(self.emulator, f"{name}.velocity_") for name in self.scene.materials]
        limits = torch.stack([torch.maximum(low.abs(), high.abs()) for low, high in ranges]).to(velocity)
        ratio = (velocity.detach().abs() / limits[material].clamp(min=1e-30)).amax(-1)
        fastest = int(ratio.argmax())
        most, (scene, particle) = float(ratio.max()), divmod(fastest, self.count)
        particle_is = (
            f"Scene {scene}, particle {particle}: the fastest, with the velocity"
            f" {_format(velocity[scene, particle])} length/s"
        )
        limit = _format(limits[material[scene, particle]])
        if most > self.too_fast:
            raise DataError(
                f"{particle_is}, is far beyond {limit}, up to which the model was calibrated. Velocities are in domain"
                " length per second."
            )
        if 0 < most < SUSPICIOUSLY_SLOW and TOO_FAST / 100 < most / self.scene.dt < TOO_FAST:
            warnings.warn(
                f"{particle_is}, is very slow beside {limit}, up to which the model was calibrated. Velocities are in"
                f" domain length per second; if yours are per frame, divide them by dt = {self.scene.dt:g} s.",
                stacklevel=4,
            )

    def _check_obstacles(self, state: Particles) -> None:
        """Warn of particles that start inside an obstacle, where recorded ones never are."""
        if not state.obstacle.shape[1]:
            return
        with torch.no_grad():
            state = state.to(self.emulator.device)
            share = obstacle_share(self.emulator.solid(state), self.emulator.walls)
            inside = Contact(share, self.emulator.grid).inside(self.emulator.in_cells(state)[0]).cpu()
        if inside.any():
            scene, particle = map(int, inside.nonzero()[0])
            warnings.warn(
                f"Scene {scene}: {int(inside[scene].sum())} of {self.count} particles start inside an obstacle, the"
                f" first of them particle {particle} at {_format(self.position[scene, particle])}. The model was not"
                " trained for that, and they may hold up the rest: move them or the obstacle.",
                stacklevel=4,
            )

    def _expand(self, name: str, given: Any, allowed: list[tuple[int, ...]], shape: tuple[int, ...]) -> Tensor:
        tensor = _numbers(name, given)
        if tuple(tensor.shape) not in allowed:
            raise DataError(
                f"{name} has the shape {tuple(tensor.shape)}; with positions {tuple(self.position.shape)} it must be"
                f" {' or '.join(map(str, allowed))}."
            )
        return tensor.expand(shape)


def _numbers(name: str, values: Any) -> Tensor:
    """The values as a float64 tensor of its own memory, on the CPU.

    Raises:
        DataError: if they are not real numbers.
    """
    try:
        if not isinstance(values, Tensor) and (array := np.asarray(values)).dtype.kind in "iuf":
            values = array.astype(np.float64)  # torch takes neither all strides nor other byte orders
        tensor = values if isinstance(values, Tensor) else torch.as_tensor(np.asarray(values))
    except (TypeError, ValueError, RuntimeError) as error:
        raise DataError(f"{name} cannot be read as an array of numbers: {one_line(error)}.") from error
    if tensor.is_complex() or tensor.dtype is torch.bool:
        raise DataError(f"{name} holds {str(tensor.dtype).removeprefix('torch.')} values; real numbers are needed.")
    return tensor.to("cpu", torch.float64, copy=True)


def _precision(values: Any) -> torch.dtype:
    """Floating-point type of values; float64 of what is none."""
    if isinstance(values, Tensor):
        return values.dtype if values.is_floating_point() else torch.float64
    given = np.asarray(values).dtype
    return {2: torch.float16, 4: torch.float32}.get(given.itemsize if given.kind == "f" else 8, torch.float64)


def _format(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values.tolist()) + ")"


THROWN = 1000
"""Particles of thrown blocks, about, unless their number is given."""
_SAME_GRAVITY = 0.05
"""Share of the model's gravity by which that of data may differ, as it may be measured."""


def thrown_state(
    emulator: Emulator, seed: int, count: int, blocks: int | None = None, gravity: Any = None
) -> Particles:
    """Blocks of particles thrown into the scene's box; see `Pretrained.example`."""
    blocks = len(emulator.scene.materials) if blocks is None else blocks
    for name, value, least in (("seed", seed, 0), ("count", count, 1), ("blocks", blocks, 1)):
        check_whole(name, value, least)
    try:
        state = thrown_blocks(emulator.scene, count=count, blocks=blocks, seed=seed)
    except ValueError as error:
        raise ConfigError(f"{error} Use fewer particles or more blocks.") from error
    if gravity is None:
        return with_usual_gravity(emulator, state)
    builder = StateBuilder(emulator, state.position, state.position.dtype)
    return dataclasses.replace(state, gravity=builder.gravity(gravity))


def state_of(
    emulator: Emulator,
    trajectory: Trajectory,
    frame: int = 1,
    materials: Mapping[str, str] | None = None,
    too_fast: float = TOO_FAST,
) -> Particles:
    """The state of a trajectory at a frame; see `Pretrained.start`."""
    scene = emulator.scene
    metadata = _metadata(scene, trajectory)
    frames = len(trajectory.position)
    if not 1 <= frame < frames:
        raise ConfigError(f"frame = {frame} must be 1 … {frames - 1}: velocities need the frame before it.")
    if metadata.dim != scene.dim:
        raise DataError(f"The trajectory has {metadata.dim} axes, the model {scene.dim}.")
    back = min(frame, max(1, round(scene.dt / metadata.dt)))
    steps = _steps(trajectory, metadata, frame, back)
    present, position = ~np.isnan(steps[1, :, 0]), trajectory.position[frame]
    types = trajectory.particle_type
    moving, obstacle = metadata.is_moving(types) & present, np.isin(types, list(metadata.obstacle_types)) & present
    if not moving.any():
        raise DataError(f"No particle that moves is there in frames {frame - back} and {frame} of the trajectory.")
    builder = StateBuilder(emulator, position[moving], None, too_fast)
    state = builder.build(
        velocity=_velocity(scene, trajectory, metadata, steps[:, moving], back),
        material=_materials(scene, metadata, types[moving], {**dict(scene.aliases), **(materials or {})}),
        obstacle=position[obstacle] if obstacle.any() else None,
        gravity=_gravity(scene, trajectory, metadata),
        fields=_fields(scene, trajectory, frame, moving),
        bodies=None,
        volume=relative_volumes(trajectory, moving),
    ).to(emulator.device)
    if not scene.moving_obstacles or not obstacle.any():
        return state
    moved = torch.from_numpy(steps[1, obstacle] / (back * metadata.dt)).to(state.obstacle) * scene.dt
    return dataclasses.replace(state, obstacle_velocity=moved[None])


def _steps(trajectory: Trajectory, metadata: Metadata, frame: int, back: int) -> np.ndarray:
    """(2, N, D) the last two steps of `back` frames until a frame, the earlier one NaN where that is not recorded."""
    last, first = displacements(trajectory.position[frame - back : frame + 1], metadata).sum(axis=0), frame - 2 * back
    if first < 0:
        return np.stack([np.full_like(last, np.nan), last])
    return np.stack([displacements(trajectory.position[first : frame - back + 1], metadata).sum(axis=0), last])


def _velocity(scene: Scene, trajectory: Trajectory, metadata: Metadata, steps: np.ndarray, back: int) -> np.ndarray:
    """(N, D) velocity in length per second, that between the last two frames of the model, of (2, N, D) `_steps`."""
    ratio = scene.dt / (back * metadata.dt)
    ratio = 1.0 if math.isclose(ratio, 1.0, rel_tol=1e-3) else ratio
    pull = trajectory_gravity(trajectory.attributes, metadata, "the trajectory") or (0.0,) * metadata.dim
    before, last = map(torch.from_numpy, steps)
    gravity = last.new_tensor(pull).view(1, -1) * (back * metadata.dt) ** 2
    return model_velocity(last, last - before, gravity, ratio).numpy() / (ratio * back * metadata.dt)


def _metadata(scene: Scene, trajectory: Trajectory) -> Metadata:
    """The trajectory's; without, all particles are the model's only material."""
    if trajectory.metadata is not None:
        return trajectory.metadata
    kinds = np.unique(trajectory.particle_type)
    if len(scene.materials) > 1 or len(kinds) > 1:
        raise DataError(
            f"The trajectory does not say what its particle types {kinds.tolist()} are. Take it from"
            " nmpm.load_trajectories, which knows their names."
        )
    return Metadata(
        bounds=scene.bounds,
        dt=scene.dt,
        dim=trajectory.position.shape[2],
        sequence_length=1,
        particle_types={int(kinds[0]): scene.materials[0]},
        boundary=scene.boundary,
    )


def _materials(scene: Scene, metadata: Metadata, types: np.ndarray, renamed: Mapping[str, str]) -> list[str]:
    """Names of the particles' materials, of the model's."""
    ids = np.unique(types).tolist()
    names = {i: renamed.get(metadata.particle_types[i], metadata.particle_types[i]) for i in ids}
    theirs = scene.materials
    unknown = sorted({name for name in names.values() if name not in theirs})
    if unknown:
        raise DataError(
            f"The trajectory has {', '.join(unknown)}, the model {', '.join(theirs)}.{suggestion(unknown[0], theirs)}"
            f" State which is which: start(…, materials={{{unknown[0]!r}: {theirs[0]!r}}})."
        )
    return [names[i] for i in types.tolist()]


def _gravity(scene: Scene, trajectory: Trajectory, metadata: Metadata) -> Any:
    """The trajectory's gravity where the model needs one, or knows another than this."""
    gravity = trajectory_gravity(trajectory.attributes, metadata, "the trajectory")
    if scene.gravity_varies or gravity is None or scene.gravity is None:
        return gravity if scene.gravity_varies else None
    return None if is_gravity_of(scene, gravity) else gravity


def is_gravity_of(scene: Scene, gravity: Sequence[float]) -> bool:
    """Whether a trajectory's gravity, which may be measured, is that of a model's scene."""
    stated = np.array(scene.gravity)
    return np.allclose(gravity, stated, rtol=0, atol=_SAME_GRAVITY * float(np.abs(stated).max()))


def _fields(scene: Scene, trajectory: Trajectory, frame: int, moving: np.ndarray) -> dict[str, Any]:
    """Fields of the model's scene that the trajectory has, at a frame."""
    frames, particles = trajectory.position.shape[:2]
    fields: dict[str, Any] = {}
    for name in scene.fields:
        values = trajectory.fields.get(name, trajectory.attributes.get(name))
        if values is None:
            continue
        values = np.asarray(values)
        values = values[frame] if values.shape == (frames, particles) else values
        fields[name] = values[moving] if values.shape == (particles,) else values.reshape(())
    return fields
