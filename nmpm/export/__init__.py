"""Trained emulators as files that run without this package: ONNX, and machine code of AOTInductor."""

from nmpm.export.describe import description
from nmpm.export.formats import FORMATS
from nmpm.export.parts import Network, Part, Solid, Step, Value

__all__ = ["FORMATS", "Network", "Part", "Solid", "Step", "Value", "description"]
