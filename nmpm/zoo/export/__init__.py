"""Trained emulators as files that run without this package: ONNX, and AOTInductor packages."""

from nmpm.zoo.export.describe import description
from nmpm.zoo.export.formats import FORMATS
from nmpm.zoo.export.parts import Network, Part, Solid, Step, Value

__all__ = ["FORMATS", "Network", "Part", "Solid", "Step", "Value", "description"]
