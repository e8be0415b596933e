"""Rollout metrics: the contract and one metric per file.

A metric is added by one file and one line here; others are named by their class path in a configuration.
"""

from nmpm.metrics.base import RolloutMetric
from nmpm.metrics.earth_mover import EarthMover, earth_mover, earth_mover_of_materials
from nmpm.metrics.fields import FieldMSE
from nmpm.metrics.mse import MSE, overall_error

__all__ = [
    "MSE",
    "EarthMover",
    "FieldMSE",
    "RolloutMetric",
    "earth_mover",
    "earth_mover_of_materials",
    "overall_error",
]
