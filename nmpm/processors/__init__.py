"""Grid processors: the contract and one network per file.

A processor is added by one file and one line here; others are named by their class path in a configuration.
"""

from nmpm.processors.base import GridLayout, GridProcessor, Processor
from nmpm.processors.fno import FNO
from nmpm.processors.pointwise import Pointwise
from nmpm.processors.unet import UNet

__all__ = ["FNO", "GridLayout", "GridProcessor", "Pointwise", "Processor", "UNet"]
