"""Rollout metrics; those of others are named by their class path in a configuration."""

from nmpm.metrics.earth_mover import EarthMover, check_emd, earth_mover, earth_mover_of_materials
from nmpm.metrics.mse import MSE, FieldMSE, RolloutMetric, overall_error

__all__ = [
    "MSE",
    "EarthMover",
    "FieldMSE",
    "RolloutMetric",
    "check_emd",
    "earth_mover",
    "earth_mover_of_materials",
    "overall_error",
]
