"""The stress battery: a trained emulator at the extremes, one line of pass or fail for each."""

from nmpm.evaluation.stress.battery import GROUPS, battery
from nmpm.evaluation.stress.lines import FULL, QUICK, Line, Size
from nmpm.evaluation.stress.subject import Subject

__all__ = ["FULL", "GROUPS", "QUICK", "Line", "Size", "Subject", "battery"]
