"""The trade between speed and accuracy: models, the simulator and trivial predictors, measured on the same scenes."""

from nmpm.evaluation.trade.choice import Choice, Kind
from nmpm.evaluation.trade.datasets import find_scenes, find_wider_scenes
from nmpm.evaluation.trade.measure import count_steps, measure
from nmpm.evaluation.trade.points import Point
from nmpm.evaluation.trade.scenes import Scenes, read_scenes
from nmpm.evaluation.trade.store import Store
from nmpm.evaluation.trade.sweep import Sweep, default_sweep_text, make_choices, read_sweep

__all__ = [
    "Choice",
    "Kind",
    "Point",
    "Scenes",
    "Store",
    "Sweep",
    "count_steps",
    "default_sweep_text",
    "find_scenes",
    "find_wider_scenes",
    "make_choices",
    "measure",
    "read_scenes",
    "read_sweep",
]
