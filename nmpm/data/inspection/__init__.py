"""Summarises a dataset and reports its anomalies, in one pass over the trajectories."""

from nmpm.data.inspection.dataset import inspect as inspect
from nmpm.data.inspection.facts import Inspection as Inspection
