"""Trained emulators as files that run without this package: ONNX, and AOTInductor packages."""

from nmpm.zoo.export.formats import FORMATS, Format, description
from nmpm.zoo.export.parts import ExportedPart, Network, Solid, Step, Value

__all__ = ["FORMATS", "ExportedPart", "Format", "Network", "Solid", "Step", "Value", "description"]
