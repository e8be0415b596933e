"""Pinned batches, for copies to a GPU that overlap with its work."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from nmpm.particles import Window


def pin_for(device: torch.device, batches: Iterator[Window]) -> Iterator[Window]:
    """Pins batches in host memory where the device that they will be copied to is a GPU.

    Args:
        device: Where the batches will be used.
        batches: In host memory.
    """
    return map(Window.pin_memory, batches) if device.type == "cuda" else batches
