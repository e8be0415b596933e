"""The stress battery: a trained emulator at the extremes, one result of pass or fail for each."""

from nmpm.evaluation.stress.battery import GROUPS, battery
from nmpm.evaluation.stress.model import ModelUnderTest
from nmpm.evaluation.stress.results import FULL, QUICK, Effort, TestResult

__all__ = ["FULL", "GROUPS", "QUICK", "Effort", "ModelUnderTest", "TestResult", "battery"]
