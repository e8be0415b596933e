"""Grid processors: the contract, and the networks that fulfil it.

A processor is added by one class and one line here; others are named by their class path in a configuration.
"""

from nmpm.processors.axial import Axial
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor
from nmpm.processors.baselines import Identity, Pointwise
from nmpm.processors.fourier import FFNO, FNO, TFNO
from nmpm.processors.unet import ConvNeXt, UNet, UNetModern
from nmpm.processors.wrappers import Patched, Stochastic, Turned

__all__ = [
    "FFNO",
    "FNO",
    "TFNO",
    "Axial",
    "ChannelLayers",
    "ConvNeXt",
    "GridLayout",
    "GridProcessor",
    "Identity",
    "Patched",
    "Pointwise",
    "Processor",
    "Stochastic",
    "Turned",
    "UNet",
    "UNetModern",
]
