"""Training with Lightning: the module, its losses, schedules and callbacks, and the checkpoints that it leaves."""

from nmpm.training.module import EmulatorModule

__all__ = ["EmulatorModule"]
