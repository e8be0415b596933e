"""The Graph Network-based Simulator in plain torch, a baseline for `nmpm trade`; `gns.py` trains it.

Source: Sanchez-Gonzalez, Godwin, Pfaff, Ying, Leskovec & Battaglia, Learning to Simulate Complex Physics with Graph
Networks, ICML 2020, arXiv 2002.09405. Accelerations are predicted from the last velocities and the distance to the
walls. N moving and M static particles, D dimensions, E directed edges, H velocities seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from nmpm.errors import ConfigError, DataError
from nmpm.particles import Particles
from nmpm.scene import Scene

HISTORY = 5
"""Velocities that a particle sees, as in the paper."""
REACH = 2.1
"""Radius of the graph in particle spacings: the 12 nearest neighbours of a square lattice, as in the paper's scenes."""
STEPS = 10
"""Message-passing steps, as in the paper."""
MOST_NEIGHBOURS = 200
"""Mean number of neighbours beyond which particles have collapsed into each other; there are 13 at rest."""


def radius_graph(position: Tensor, radius: float) -> Tensor:
    """Directed edges between particles (N, D) at most a radius apart, both ways, without loops.

    Returns:
        (2, E) int64: senders and receivers.

    Raises:
        DataError: if a position is not finite, or particles have collapsed, see `MOST_NEIGHBOURS`.
    """
    if not bool(position.isfinite().all()):
        raise DataError("A particle's position is not finite, so that it has no neighbours.")
    tree = cKDTree(position.detach().double().numpy())
    if int(tree.count_neighbors(tree, radius)) - tree.n > MOST_NEIGHBOURS * len(position):  # takes no memory for pairs
        raise DataError(f"Particles have collapsed: over {MOST_NEIGHBOURS} neighbours each within {radius:g}.")
    pairs = torch.from_numpy(tree.query_pairs(radius, output_type="ndarray")).long().reshape(-1, 2)
    return torch.cat([pairs, pairs.flip(1)]).T.contiguous()


def perceptron(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """A multilayer perceptron with two hidden layers and ReLU."""
    return nn.Sequential(
        nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, outputs)
    )


class MessagePassing(nn.Module):
    """One step: each edge is updated from its ends, each node from the sum of its incoming edges; both residually."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.sender = nn.Linear(width, width, bias=False)
        self.receiver = nn.Linear(width, width, bias=False)
        self.edge = nn.Sequential(perceptron(width, width, width), nn.LayerNorm(width))
        self.node = nn.Sequential(perceptron(2 * width, width, width), nn.LayerNorm(width))

    def forward(self, nodes: Tensor, edges: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        """New latent vectors (N, W) and (E, W).

        The first layer of the edges' perceptron sees edge, sender and receiver side by side; its products with the
        ends are taken once per node instead of once per edge, which is the same sum.
        """
        sender, receiver = ends
        first, *rest = cast(nn.Sequential, self.edge[0])
        mixed = first(edges) + self.sender(nodes)[sender] + self.receiver(nodes)[receiver]
        for layer in rest:
            mixed = layer(mixed)
        message = self.edge[1](mixed)
        incoming = torch.zeros_like(nodes).index_add(0, receiver, message)
        return nodes + self.node(torch.cat([nodes, incoming], dim=-1)), edges + message


class GraphNetwork(nn.Module):
    """Encode features of nodes and edges, pass messages in steps with weights of their own, decode outputs of nodes."""

    def __init__(self, node_features: int, edge_features: int, outputs: int, width: int, steps: int) -> None:
        super().__init__()
        self.encode_nodes = nn.Sequential(perceptron(node_features, width, width), nn.LayerNorm(width))
        self.encode_edges = nn.Sequential(perceptron(edge_features, width, width), nn.LayerNorm(width))
        self.steps = nn.ModuleList(MessagePassing(width) for _ in range(steps))
        self.decode = perceptron(width, width, outputs)

    def forward(self, nodes: Tensor, edges: Tensor, ends: Tensor) -> Tensor:
        """Outputs (N, O) of nodes (N, F) and edges (E, G) with ends (2, E): senders and receivers."""
        nodes, edges = self.encode_nodes(nodes), self.encode_edges(edges)
        for step in self.steps:
            nodes, edges = step(nodes, edges, ends)
        decoded: Tensor = self.decode(nodes)
        return decoded


@dataclass(frozen=True)
class Neighbours:
    """The inputs that stay the same over a rollout: materials (N,), static particles (M, D) and gravity (D,)."""

    material: Tensor
    obstacle: Tensor
    gravity: Tensor


class GraphSimulator(nn.Module):
    """Predicts the next frame of one scene from the last ones, on the CPU; `width` is that of the latent vectors."""

    velocity_mean: Tensor
    velocity_std: Tensor
    acceleration_mean: Tensor
    acceleration_std: Tensor

    def __init__(self, scene: Scene, width: int = 128, steps: int = STEPS) -> None:
        super().__init__()
        if any(scene.periodic) or scene.fields:
            raise ConfigError("Graph simulators are implemented for walls and positions, not for periods and fields.")
        self.scene, self.width, self.steps = scene, width, steps
        self.radius = REACH * scene.particle_spacing
        kinds = len(scene.materials) + scene.obstacles
        inputs = (HISTORY + 2 + scene.gravity_varies) * scene.dim + kinds  # velocities, walls, gravity; kind
        self.network = GraphNetwork(inputs, scene.dim + 1, scene.dim, width, steps)
        for name in ("velocity", "acceleration"):
            self.register_buffer(f"{name}_mean", torch.zeros(scene.dim))
            self.register_buffer(f"{name}_std", torch.ones(scene.dim))

    def forward(self, history: Tensor, around: Neighbours) -> Tensor:
        """Normalised accelerations (N, D) from positions (N, H + 1, D), the present ones last."""
        static = around.obstacle.unsqueeze(1).expand(-1, history.shape[1], -1)
        frames = torch.cat([history, static])
        present = frames[:, -1]
        velocity = (frames.diff(dim=1) - self.velocity_mean) / self.velocity_std
        low, high = present.new_tensor(self.scene.bounds).T
        walls = torch.cat([present - low, high - present], dim=-1) / self.radius
        materials = len(self.scene.materials)  # obstacles are a kind of their own
        kinds = torch.cat([around.material, around.material.new_full((len(around.obstacle),), materials)])
        kinds = nn.functional.one_hot(kinds, materials + self.scene.obstacles).float()
        parts = [velocity.flatten(1), walls.clamp(-1, 1), kinds]
        if self.scene.gravity_varies:
            parts.append((around.gravity / self.acceleration_std).expand_as(present))
        ends = radius_graph(present, self.radius)
        offset = (present[ends[0]] - present[ends[1]]) / self.radius
        edges = torch.cat([offset, offset.norm(dim=-1, keepdim=True)], dim=-1)
        output: Tensor = self.network(torch.cat(parts, dim=-1), edges, ends)
        return output[: len(history)]

    def advance(self, history: Tensor, around: Neighbours) -> Tensor:
        """The next positions (N, D): x + v + a, frames being equal steps."""
        acceleration = self(history, around) * self.acceleration_std + self.acceleration_mean
        next_position: Tensor = 2 * history[:, -1] - history[:, -2] + acceleration
        return next_position

    @torch.no_grad()
    def rollout(self, state: Particles, frames: int) -> Tensor:
        """Predict frames of each scene, (B, frames, N, D); padding stays where it is.

        Velocities of before the state, which is all that a rollout knows, are taken to be its own.

        Raises:
            DataError: if positions become non-finite or particles collapse, naming the frame; if the state has
                obstacles as bodies, which are no particles.
        """
        if state.obstacle_share is not None:
            raise DataError("The state has obstacles as bodies: graph networks need them filled with particles.")
        path = state.position.unsqueeze(1).repeat(1, frames, 1, 1)
        for index, mask in enumerate(state.mask):
            position, velocity = state.position[index, mask], state.velocity[index, mask]
            static = state.obstacle[index, state.obstacle_mask[index]]
            around = Neighbours(state.material[index, mask], static, state.gravity[index])
            history = extend_back(torch.stack([position - velocity, position], dim=1), HISTORY + 1)
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
