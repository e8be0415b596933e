"""A graph network as a simulator: accelerations from the last velocities and the distance to the walls."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor, nn

from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.gns.graph import radius_graph
from nmpm.evaluation.gns.network import GraphNetwork
from nmpm.particles import Particles
from nmpm.scene import Scene

REACH = 2.1
"""Radius of the graph in particle spacings: the 12 nearest neighbours of a square lattice, as in the paper's scenes."""


@dataclass(frozen=True)
class GraphRecipe:
    """The form of a graph simulator; the defaults are the paper's.

    Args:
        scene: Facts of the scenes.
        width: Of the latent vectors and hidden layers.
        steps: Message-passing steps.
        history: Velocities that a particle sees, those of the last frames.
        reach: Radius of the graph, in particle spacings.

    Raises:
        ConfigError: if a number is not positive, an axis is periodic, or the scene has fields.
    """

    scene: Scene
    width: int = 128
    steps: int = 10
    history: int = 5
    reach: float = REACH

    def __post_init__(self) -> None:
        for name in ("width", "steps", "history", "reach"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} = {getattr(self, name)} of a graph simulator must be positive.")
        if any(self.scene.periodic):
            raise ConfigError("Graph simulators are implemented for walls, not for periodic axes.")
        if self.scene.fields:
            raise ConfigError(f"Graph simulators read no fields, and the scene has {', '.join(self.scene.fields)}.")

    @property
    def radius(self) -> float:
        """Radius of the graph, in domain length."""
        return self.reach * self.scene.particle_spacing

    @property
    def node_features(self) -> int:
        """Inputs of a node: velocities, distances to the walls, kind, and gravity where it varies."""
        scene = self.scene
        vectors = self.history + 2 + scene.gravity_varies
        return vectors * scene.dim + len(scene.materials) + scene.obstacles

    def build(self) -> GraphSimulator:
        """A simulator of this form, its weights drawn from torch's random state."""
        return GraphSimulator(self)

    def to_dict(self) -> dict[str, Any]:
        """The recipe as plain lists, strings and numbers."""
        names = (field.name for field in dataclasses.fields(self) if field.name != "scene")
        return {"scene": self.scene.to_dict(), **{name: getattr(self, name) for name in names}}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """The recipe that `to_dict` described.

        Raises:
            ConfigError: if a key is missing, unknown or wrong.
        """
        try:
            return cls(**{**plain, "scene": Scene.from_dict(plain["scene"])})
        except (TypeError, KeyError) as error:
            raise ConfigError(f"The recipe of a graph simulator cannot be read: {error}.") from error


@dataclass(frozen=True)
class Surroundings:
    """The inputs of a scene that stay the same over a rollout.

    Args:
        material: (N,) int64.
        obstacle: (M, D) particles that do not move; M may be 0.
        gravity: (D,) in length per frame squared.
    """

    material: Tensor
    obstacle: Tensor
    gravity: Tensor


class GraphSimulator(nn.Module):
    """Predicts the next frame of one scene from the last ones, on the CPU.

    Args:
        recipe: Its form.
    """

    velocity_mean: Tensor
    velocity_std: Tensor
    acceleration_mean: Tensor
    acceleration_std: Tensor

    def __init__(self, recipe: GraphRecipe) -> None:
        super().__init__()
        self.recipe = recipe
        dim = recipe.scene.dim
        self.network = GraphNetwork(recipe.node_features, dim + 1, dim, recipe.width, recipe.steps)
        for name in ("velocity", "acceleration"):
            self.register_buffer(f"{name}_mean", torch.zeros(dim))
            self.register_buffer(f"{name}_std", torch.ones(dim))

    def features(self, history: Tensor, around: Surroundings) -> tuple[Tensor, Tensor, Tensor]:
        """Features of nodes (N + M, F) and edges (E, D + 1), and the edges' ends (2, E); no absolute position enters.

        Args:
            history: (N, H + 1, D) positions of the last frames, the present one last.
            around: Of N moving and M static particles.
        """
        static = around.obstacle.unsqueeze(1).expand(-1, history.shape[1], -1)
        frames = torch.cat([history, static])
        present = frames[:, -1]
        velocity = (frames.diff(dim=1) - self.velocity_mean) / self.velocity_std
        low, high = present.new_tensor(self.recipe.scene.bounds).T
        walls = torch.cat([present - low, high - present], dim=-1) / self.recipe.radius
        parts = [velocity.flatten(1), walls.clamp(-1, 1), self._kinds(around)]
        if self.recipe.scene.gravity_varies:
            parts.append((around.gravity / self.acceleration_std).expand_as(present))
        ends = radius_graph(present, self.recipe.radius)
        offset = (present[ends[0]] - present[ends[1]]) / self.recipe.radius
        return torch.cat(parts, dim=-1), torch.cat([offset, offset.norm(dim=-1, keepdim=True)], dim=-1), ends

    def _kinds(self, around: Surroundings) -> Tensor:
        """One at each particle's material, or at the last column for obstacles: (N + M, K)."""
        scene = self.recipe.scene
        static = around.material.new_full((len(around.obstacle),), len(scene.materials))
        kinds = torch.cat([around.material, static])
        return nn.functional.one_hot(kinds, len(scene.materials) + scene.obstacles).float()

    def forward(self, history: Tensor, around: Surroundings) -> Tensor:
        """Normalised accelerations (N, D) of the moving particles."""
        output: Tensor = self.network(*self.features(history, around))
        return output[: len(history)]

    def advance(self, history: Tensor, around: Surroundings) -> Tensor:
        """The next positions (N, D): x + v + a, frames being equal steps."""
        acceleration = self(history, around) * self.acceleration_std + self.acceleration_mean
        next_position: Tensor = 2 * history[:, -1] - history[:, -2] + acceleration
        return next_position

    @torch.no_grad()
    def rollout(self, state: Particles, frames: int) -> Tensor:
        """Predict frames of each scene, (B, frames, N, D); padding stays where it is.

        Velocities of before the state, which is all that a rollout knows, are taken to be its own.

        Raises:
            DataError: if positions become non-finite or particles collapse; the message names the frame. If the
                state's obstacles are bodies, which are no particles.
        """
        if state.obstacle_share is not None:
            raise DataError("The state has obstacles as bodies: graph networks need them filled with particles.")
        path = state.position.unsqueeze(1).repeat(1, frames, 1, 1)
        for index, mask in enumerate(state.mask):
            position, velocity = state.position[index, mask], state.velocity[index, mask]
            static = state.obstacle[index, state.obstacle_mask[index]]
            around = Surroundings(state.material[index, mask], static, state.gravity[index])
            history = extend_back(torch.stack([position - velocity, position], dim=1), self.recipe.history + 1)
            for frame in range(frames):
                try:
                    following = self.advance(history, around)
                except DataError as error:
                    raise DataError(f"Frame {frame + 1} cannot be predicted: {error}") from error
                history = torch.cat([history[:, 1:], following.unsqueeze(1)], dim=1)
                path[index, frame, mask] = following
        return path


def extend_back(frames: Tensor, length: int) -> Tensor:
    """The last `length` of some frames (N, T, D), T >= 2; missing ones as if the first velocity had been constant."""
    missing = length - frames.shape[1]
    if missing <= 0:
        return frames[:, -length:]
    steps = torch.arange(-missing, 0, dtype=frames.dtype).view(1, -1, 1)
    before = frames[:, :1] + steps * (frames[:, 1:2] - frames[:, :1])
    return torch.cat([before, frames], dim=1)
