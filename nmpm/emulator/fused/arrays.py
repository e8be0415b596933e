"""Tensors of a batch as the arrays that kernels take: float32 on the CPU, without gradients, C-contiguous."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.fused.plan import Plan
from nmpm.transfer.fused.fields import unpack_bfloat16, unpack_float32


def as_array(tensor: Tensor) -> Any:
    """The tensor's memory; a copy where it is not contiguous."""
    return np.ascontiguousarray(tensor.detach().numpy())


def as_copy(tensor: Tensor) -> Any:
    """A copy, which may be changed."""
    return tensor.detach().clone(memory_format=torch.contiguous_format).numpy()


def output_rows(output: Tensor) -> tuple[Any, Any]:
    """A network's output as rows (B, size, m C), one per node, and the kernel that unpacks them."""
    rows = output.detach().movedim((1, 2), (-2, -1)).flatten(-2).flatten(1, -2)
    if output.dtype == torch.bfloat16:
        return rows.contiguous().view(torch.uint16).numpy(), unpack_bfloat16
    return rows.float().contiguous().numpy(), unpack_float32


def material_rows(material: Tensor, materials: int) -> Any:
    """(B, N) indices, (B, 0) where there is only one material."""
    return as_array(material) if materials > 1 else np.empty((len(material), 0), np.int64)


def check_materials(plan: Plan, material: Any) -> None:
    """Raise IndexError if an index of `material_rows` is none of the scene's materials."""
    if material.size and not (material.min() >= 0 and material.max() < len(plan.mass)):
        raise IndexError(f"A particle's material is not an index from 0 to {len(plan.mass) - 1}.")
