"""Trained emulators as files that run without this package: ONNX, and AOTInductor packages."""

from nmpm.zoo.export.formats import FORMATS, Format, description
from nmpm.zoo.export.parts import Network, Part, Solid, Step, Value

__all__ = ["FORMATS", "Format", "Network", "Part", "Solid", "Step", "Value", "description"]
