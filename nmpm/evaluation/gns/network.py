"""Encode, pass messages, decode: a network on a graph of particles."""

from __future__ import annotations

from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

_HIDDEN_LAYERS = 2


def perceptron(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """A multilayer perceptron with two hidden layers and ReLU."""
    sizes = [inputs, *[width] * _HIDDEN_LAYERS]
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(width, outputs))


class MessagePassing(nn.Module):
    """One step: each edge is updated from its ends, each node from the sum of its incoming edges; both residually.

    Args:
        width: Of the latent vectors of nodes and edges.
    """

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
    """From features of nodes and edges to an output of each node; equivariant under permutations of the nodes.

    Args:
        node_features: Inputs of a node.
        edge_features: Inputs of an edge.
        outputs: Of a node.
        width: Of the latent vectors and hidden layers.
        steps: Message-passing steps, each with weights of its own.
    """

    def __init__(self, node_features: int, edge_features: int, outputs: int, width: int, steps: int) -> None:
        super().__init__()
        self.encode_nodes = nn.Sequential(perceptron(node_features, width, width), nn.LayerNorm(width))
        self.encode_edges = nn.Sequential(perceptron(edge_features, width, width), nn.LayerNorm(width))
        self.steps = nn.ModuleList(MessagePassing(width) for _ in range(steps))
        self.decode = perceptron(width, width, outputs)

    def forward(self, nodes: Tensor, edges: Tensor, ends: Tensor) -> Tensor:
        """Outputs (N, O).

        Args:
            nodes: (N, F) features.
            edges: (E, G) features.
            ends: (2, E) int64, senders and receivers.
        """
        nodes, edges = self.encode_nodes(nodes), self.encode_edges(edges)
        for step in self.steps:
            nodes, edges = step(nodes, edges, ends)
        decoded: Tensor = self.decode(nodes)
        return decoded
