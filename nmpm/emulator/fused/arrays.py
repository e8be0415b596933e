"""Tensors of a batch as the arrays that kernels take: float32 on the CPU, without gradients, C-contiguous."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.fused.plan import Plan
from nmpm.emulator.fused.views import as_array as as_array
from nmpm.transfer.fused.fields import unpack_bfloat16, unpack_float32


def as_copy(tensor: Tensor) -> Any:
    """A copy, which may be changed."""
    return tensor.detach().clone(memory_format=torch.contiguous_format).numpy()


def output_arrays(output: Tensor) -> tuple[Any, Any]:
    """A network's output (B, m, C, *S) as an array (B, m, C, size), and the kernel that unpacks it, of any strides."""
    values = output.detach().flatten(3)
    if output.dtype == torch.bfloat16:  # which Numpy lacks: as bits
        return values.view(torch.uint16).numpy(), unpack_bfloat16
    return values.float().numpy(), unpack_float32


def material_rows(material: Tensor, materials: int) -> Any:
    """(B, N) indices, (B, 0) where there is only one material."""
    return as_array(material) if materials > 1 else np.empty((len(material), 0), np.int64)


def check_materials(plan: Plan, material: Any) -> None:
    """Raise IndexError if an index of `material_rows` is none of the scene's materials."""
    if material.size and not (material.min() >= 0 and material.max() < len(plan.mass)):
        raise IndexError(f"A particle's material is not an index from 0 to {len(plan.mass) - 1}.")
