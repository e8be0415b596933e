"""A particle-graph network as a baseline: the Graph Network-based Simulator, in plain torch.

Source: Sanchez-Gonzalez, Godwin, Pfaff, Ying, Leskovec & Battaglia, Learning to Simulate Complex Physics with Graph
Networks, ICML 2020, arXiv 2002.09405. Independent of the emulator: it shares the data and the measurements with it.
"""

from nmpm.evaluation.gns.files import (
    TrainedGraph,
    is_graph_folder,
    read_graph,
    read_progress,
    write_graph,
    write_progress,
)
from nmpm.evaluation.gns.graph import radius_graph
from nmpm.evaluation.gns.network import GraphNetwork
from nmpm.evaluation.gns.simulator import GraphRecipe, GraphSimulator
from nmpm.evaluation.gns.training import GraphTrainer, GraphTraining, train, validation_loss

__all__ = [
    "GraphNetwork",
    "GraphRecipe",
    "GraphSimulator",
    "GraphTrainer",
    "GraphTraining",
    "TrainedGraph",
    "is_graph_folder",
    "radius_graph",
    "read_graph",
    "read_progress",
    "train",
    "validation_loss",
    "write_graph",
    "write_progress",
]
