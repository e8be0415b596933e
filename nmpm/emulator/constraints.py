"""What a rollout may not do, whatever the network says.

Each rule is a fact about the scenes, to be switched on where it holds. But for the bounds, none acts in training, which
has to see the network's own mistakes.

All quantities are in grid units: cells, cells per frame. Energies may be in any unit of length that is the same along
each axis, as cells need not be.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import torch
from torch import Tensor

from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

MOST_GAIN = 0.01
"""Share of the initial energy, counted from `lowest_potential`, that may be gained where nothing is fed in."""


FREELY = 0.8
"""Share of gravity's acceleration from which on a particle counts as falling."""


def stop(cells: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """What gets beyond the bounds is stopped there."""
    return torch.maximum(torch.minimum(cells, high), low)


def reflect(cells: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """What gets beyond the bounds is mirrored back, as by an elastic wall; stopped if that is beyond the other side."""
    mirrored = torch.where(cells < low, 2 * low - cells, torch.where(cells > high, 2 * high - cells, cells))
    return stop(mirrored, low, high)


def refuse(cells: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """What gets beyond the bounds by less than a cell is stopped there, as rounding errors are; more is an error.

    Raises:
        DataError: naming the first particle.
    """
    beyond = ((cells < low - 1) | (cells > high + 1)).any(-1)
    if beyond.any():
        scene, particle = map(int, beyond.nonzero()[0])
        raise DataError(
            f"Scene {scene} of the batch, particle {particle}: predicted at {cells[scene, particle].tolist()} cells,"
            f" more than one beyond {low.tolist()} … {high.tolist()}; constraints.bounds = stop would hold it there."
        )
    return stop(cells, low, high)


BOUNDS: Mapping[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = MappingProxyType(
    {"stop": stop, "reflect": reflect, "error": refuse}
)
"""What happens to positions (B, N, D) beyond the bounds (D,), by name."""


@dataclass(frozen=True)
class Constraints:
    """Facts that rollouts are held to.

    Args:
        energy: Kinetic and potential energy never exceed those of the rollout's first state: nothing feeds the scene,
            neither moving walls nor inlets, and its gravity is known.
        rest_speed: What moves less than so many cells per frame, on average over a bundle, and does not fall freely,
            stays where it is. To be set to the speed that the model sees in material that is at rest.
        solids: Nobody gets into obstacles.
        bounds: What happens to what would leave the scene's bounds, one of `BOUNDS`; in training too.

    Raises:
        ConfigError: if the speed is negative, or the bounds' rule unknown.
    """

    energy: bool = False
    rest_speed: float = 0.0
    solids: bool = True
    bounds: str = "stop"

    def __post_init__(self) -> None:
        if self.bounds not in BOUNDS:
            raise ConfigError(f"constraints.bounds = {self.bounds!r} is not one of {', '.join(BOUNDS)}.")
        if not self.rest_speed >= 0:
            raise ConfigError(f"constraints.rest_speed = {self.rest_speed} must not be negative.")


def energy(cells: Tensor, velocity: Tensor, gravity: Tensor, share: Tensor) -> Tensor:
    """Mean kinetic and potential energy per mass of each scene, up to a constant.

    Args:
        cells: (B, ..., N, D).
        velocity: (B, ..., N, D).
        gravity: (B, 1, D).
        share: (B, N, 1), each particle's part of the mean.

    Returns:
        (B, ...).
    """
    extra = (1,) * (cells.dim() - 3)
    batch, count, dim = cells.shape[0], cells.shape[-2], cells.shape[-1]
    fall = gravity.reshape(batch, *extra, 1, dim)
    each = velocity.square() / 2 - cells * fall
    return (each * share.reshape(batch, *extra, count, 1)).sum((-2, -1))


def equal_shares(mask: Tensor, dtype: torch.dtype) -> Tensor:
    """(B, N, 1): each real particle's part of a scene's mean, all of a mass; mask (B, N) bool."""
    real = mask.to(dtype)
    return (real / real.sum(-1, keepdim=True).clamp(min=1)).unsqueeze(-1)


def lowest_potential(scene: Scene, gravity: Tensor) -> Tensor:
    """Potential energy per mass where it is lowest within the scene's bounds: in one of their corners.

    Args:
        scene: Gives the bounds.
        gravity: (B, D) in length per frame².

    Returns:
        (B,) in length² per frame².
    """
    low, high = gravity.new_tensor(scene.bounds).T
    return -torch.maximum(gravity * low, gravity * high).sum(-1)


def affordable(cells: Tensor, step: Tensor, gravity: Tensor, share: Tensor, budget: Tensor) -> Tensor:
    """By what factor a scene's steps of a frame may be taken without exceeding its energy.

    With the factor s the energy after the frame is a parabola in s; the largest s in [0, 1] within the budget is taken.

    Args:
        cells: (B, N, D) where from.
        step: (B, N, D) steps proposed.
        gravity: (B, 1, D).
        share: (B, N, 1).
        budget: (B,) energy that is allowed.

    Returns:
        (B, 1, 1).
    """
    square = (step.square() * share).sum((-2, -1)) / 2
    slope = -(step * gravity * share).sum((-2, -1))
    excess = -(cells * gravity * share).sum((-2, -1)) - budget
    root = (slope.square() - 4 * square * excess).clamp(min=0).sqrt()
    tiny = torch.finfo(step.dtype).tiny
    factor = ((root - slope) / (2 * square).clamp(min=tiny)).clamp(0, 1)
    return factor[:, None, None]


def at_rest(start: Tensor, path: Tensor, speed: float, gravity: Tensor) -> Tensor:
    """Which particles move too little in a bundle to be more than the model's error.

    What falls freely is not at rest, however little it moves: at the top of its flight it would be held in the air.

    Args:
        start: (B, N, D) where the bundle starts.
        path: (B, m, N, D) its frames.
        speed: In cells per frame.
        gravity: (B, 1, D), what a frame adds to the velocity in free fall; zero where it is not known.

    Returns:
        (B, N) bool.
    """
    frames = path.shape[1]
    still: Tensor = (path[:, -1] - start).norm(dim=-1) < speed * frames
    if frames == 1:
        return still
    half = frames // 2
    middle = path[:, half - 1]
    gained = (path[:, -1] - middle) / (frames - half) - (middle - start) / half
    falling = (gained * gravity).sum(-1) > FREELY * frames / 2 * gravity.square().sum(-1)
    return still & ~falling


def otherwise_if(condition: Tensor, otherwise: Callable[[], Tensor], path: Tensor) -> Tensor:
    """A path, or another one that is only computed if a condition holds; an exported program computes both.

    Args:
        condition: () bool.
        otherwise: Gives the other path, of the same shape.
        path: (B, m, N, D).
    """
    if torch.compiler.is_exporting():  # a program has no branches that depend on its data
        return torch.where(condition, otherwise(), path)
    return otherwise() if condition else path
