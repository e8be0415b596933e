"""Constraints: physical limits enforced in rollouts whatever the network predicts.

Only `bounds` acts in training too, which has to see the network's own errors. Nothing here reads values back from the
device, except `check_within_bounds`.

All quantities are in grid units: cells, cells per frame. Energies may be in any unit of length that is the same along
each axis, as cells need not be square.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import torch
from torch import Tensor

from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

MOST_GAIN = 0.01
"""Share of the initial energy, counted from `lowest_potential`, that may be gained where nothing is fed in."""

FREE_FALL_SHARE = 0.8
"""A particle falls freely if it is accelerated by at least this share of gravity."""

BoundsRule = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From positions and the bounds' lower and upper ends, which broadcast, to positions."""


def stop(cells: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Stop positions beyond the bounds there."""
    return torch.clamp(cells, low, high)


def reflect(cells: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Mirror positions beyond the bounds, as an elastic wall does; stop those that this takes beyond the other side."""
    mirrored = torch.where(cells < low, 2 * low - cells, torch.where(cells > high, 2 * high - cells, cells))
    return stop(mirrored, low, high)


def stop_within_a_cell(cells: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Stop positions that are beyond the bounds by at most a cell; leave the others for `check_within_bounds`."""
    return torch.where((cells < low - 1) | (cells > high + 1), cells, stop(cells, low, high))


BOUNDS: Mapping[str, BoundsRule] = MappingProxyType({"stop": stop, "reflect": reflect, "error": stop_within_a_cell})
"""Rules for positions beyond the bounds, by name. With "error", `check_within_bounds` is called once per bundle."""


def check_within_bounds(path: Tensor, mask: Tensor, bounds: Tensor, confined: Sequence[bool]) -> None:
    """Reject paths (B, m, N, D) of real particles (B, N), in cells, more than a cell beyond the bounds (2, D).

    Only of axes that are `confined` by walls. One value is read back.

    Raises DataError naming scene, particle and frame of the first such position.
    """
    low, high = bounds.unbind(0)
    walls = [axis for axis, ends in enumerate(confined) if ends]
    sides = [(path[..., axis] < low[axis] - 1) | (path[..., axis] > high[axis] + 1) for axis in walls]
    beyond = torch.stack(sides).any(0) & mask.unsqueeze(1) if sides else None
    if beyond is None or not bool(beyond.any()):
        return
    frame, scene, particle = map(int, beyond.transpose(0, 1).nonzero()[0])
    raise DataError(
        f"Scene {scene} of the batch, particle {particle}: predicted at {path[scene, frame, particle].tolist()} cells"
        f" in frame {frame + 1} of the bundle, more than one beyond {low.tolist()} … {high.tolist()};"
        " constraints.bounds = stop would hold it there."
    )


def distance_beyond(position: Tensor, bounds: Sequence[tuple[float, float]], axes: Sequence[bool]) -> Tensor:
    """(...) how far positions (..., D) are beyond bounds, of those axes where most: negative within, NaN of NaN.

    Minus infinity without any axis.
    """
    sides = [
        torch.maximum(low - column, column - high)
        for column, (low, high), counts in zip(position.unbind(-1), bounds, axes, strict=True)
        if counts
    ]
    return torch.stack(sides).amax(0) if sides else position.new_full(position.shape[:-1], -math.inf)


@dataclass(frozen=True)
class Constraints:
    """The constraints of an emulator's rollouts.

    Args:
        energy: Kinetic and potential energy never exceed those of the rollout's first state: for scenes of known
            gravity that nothing feeds. It does not act where obstacles move, axes are open or particles enter.
        rest_speed: Particles that move fewer cells per frame than this, on average over a bundle, and do not fall
            freely, stay where they are if something holds them up, and fall otherwise. Set it to the speed that the
            model predicts in material that is at rest.
        solids: Particles do not enter obstacles.
        bounds: Rule for particles that would leave the scene's bounds, one of `BOUNDS`; in training too.
        density_cap: Volume fraction above which the particles of a cell spread into the room around it, after each
            bundle; 0 for no cap. `nmpm.emulator.calibration.density_cap` measures it in data.

    Raises ConfigError if the speed or the cap is negative or not finite, or the bounds' rule unknown.
    """

    energy: bool = False
    rest_speed: float = 0.0
    solids: bool = True
    bounds: str = "stop"
    density_cap: float = 0.0

    def __post_init__(self) -> None:
        if self.bounds not in BOUNDS:
            raise ConfigError(f"constraints.bounds = {self.bounds!r} is not one of {', '.join(BOUNDS)}.")
        if not self.rest_speed >= 0:
            raise ConfigError(f"constraints.rest_speed = {self.rest_speed} must not be negative.")
        if not 0 <= self.density_cap < math.inf:
            raise ConfigError(f"constraints.density_cap = {self.density_cap} must be 0, for no cap, or more.")


def energy(cells: Tensor, velocity: Tensor, gravity: Tensor, share: Tensor) -> Tensor:
    """Kinetic and potential energy per mass (B, ...) of each scene, up to a constant.

    Of positions and velocities (B, ..., N, D), gravity (B, 1, D) and shares (B, N, 1) of mass from `mass_shares`.
    """
    extra = (1,) * (cells.dim() - 3)
    batch, count, dim = cells.shape[0], cells.shape[-2], cells.shape[-1]
    fall = gravity.reshape(batch, *extra, 1, dim)
    each = velocity.square() / 2 - cells * fall
    return (each * share.reshape(batch, *extra, count, 1)).sum((-2, -1))


def mass_shares(scene: Scene, material: Tensor, volume: Tensor, dtype: torch.dtype) -> Tensor:
    """(B, N, 1) each particle's share of its scene's mass, zero for padding; sums to one in scenes with particles.

    Of `material` and `volume` (B, N), see `Particles.present_volume`. Where the scene has no densities, they are equal.
    """
    mass = volume.to(dtype)
    if len(set(scene.densities)) > 1:
        for index, density in enumerate(scene.densities):
            mass = torch.where(material == index, mass * (density / max(scene.densities)), mass)
    return (mass / mass.sum(-1, keepdim=True).clamp(min=torch.finfo(dtype).tiny)).unsqueeze(-1)


def lowest_potential(scene: Scene, gravity: Tensor) -> Tensor:
    """(B,) the lowest potential energy per mass within the scene's bounds, in length² per frame²: in a corner.

    Gravity (B, D) is in length per frame².
    """
    sides = zip(gravity.unbind(-1), scene.bounds, strict=True)
    return -torch.stack([torch.maximum(along * low, along * high) for along, (low, high) in sides]).sum(0)


def at_rest(start: Tensor, path: Tensor, speed: float, gravity: Tensor) -> Tensor:
    """(B, N) bool: whether particles move no more in a bundle than the model's error, a speed in cells per frame.

    A particle in free fall is not at rest, however little it moves: at the top of its path it would be held in the air.

    Of a bundle's start (B, N, D), its frames (B, m, N, D) and gravity (B, 1, D), zero where it is not known.
    """
    frames = path.shape[1]
    still: Tensor = (path[:, -1] - start).norm(dim=-1) < speed * frames
    if frames == 1:
        return still
    half = frames // 2
    middle = path[:, half - 1]
    gained = (path[:, -1] - middle) / (frames - half) - (middle - start) / half
    falling = (gained * gravity).sum(-1) > FREE_FALL_SHARE * frames / 2 * gravity.square().sum(-1)
    return still & ~falling
