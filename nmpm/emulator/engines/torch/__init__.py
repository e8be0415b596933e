"""The engine of tensor operations: every feature, device and precision, with gradients; traced for exports."""

from nmpm.emulator.engines.engine import EngineForm

FORMS: tuple[EngineForm, ...] = ()
"""No form is needed: what no other engine takes is this one's."""
