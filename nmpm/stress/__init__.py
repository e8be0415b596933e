"""The stress battery: a trained emulator at the extremes, one line of pass or fail for each."""

from nmpm.stress.battery import GROUPS, battery
from nmpm.stress.lines import FULL, QUICK, Line, Size
from nmpm.stress.subject import Subject

__all__ = ["FULL", "GROUPS", "QUICK", "Line", "Size", "Subject", "battery"]
