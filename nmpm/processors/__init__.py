"""Grid processors: the contract and one network per file.

A processor is added by one file and one line here; others are named by their class path in a configuration.
"""

from nmpm.processors.axial import Axial
from nmpm.processors.base import GridLayout, GridProcessor, Processor
from nmpm.processors.convnext import ConvNeXt
from nmpm.processors.ffno import FFNO
from nmpm.processors.fno import FNO, TFNO
from nmpm.processors.identity import Identity
from nmpm.processors.patched import Patched
from nmpm.processors.pointwise import Pointwise
from nmpm.processors.unet import UNet
from nmpm.processors.unet_modern import UNetModern

__all__ = [
    "FFNO",
    "FNO",
    "TFNO",
    "Axial",
    "ConvNeXt",
    "GridLayout",
    "GridProcessor",
    "Identity",
    "Patched",
    "Pointwise",
    "Processor",
    "UNet",
    "UNetModern",
]
