"""The trade between speed and accuracy: models, the simulator and trivial predictors, measured on the same scenes."""

from nmpm.evaluation.trade.choices import Kind, Predictor, find_factory, first_forms
from nmpm.evaluation.trade.measurement import Store, estimate_rest, measure, measure_errors_first, measure_untimed
from nmpm.evaluation.trade.ranking import Point
from nmpm.evaluation.trade.scenes import Scenes, find_scenes, find_wider_scenes, read_scenes
from nmpm.evaluation.trade.sweep import Sweep, make_choices, read_sweep, shipped_sweep_text

__all__ = [
    "Kind",
    "Point",
    "Predictor",
    "Scenes",
    "Store",
    "Sweep",
    "estimate_rest",
    "find_factory",
    "find_scenes",
    "find_wider_scenes",
    "first_forms",
    "make_choices",
    "measure",
    "measure_errors_first",
    "measure_untimed",
    "read_scenes",
    "read_sweep",
    "shipped_sweep_text",
]
