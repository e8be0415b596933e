"""Tensors as the arrays that kernels take, and back: of float32 on the CPU, without gradients, C-contiguous."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.engines.numba.parameters import Array, KernelParameters


def as_array(tensor: Tensor) -> Any:
    """The tensor's memory; a copy where it is not contiguous."""
    return np.ascontiguousarray(tensor.detach().numpy())


def as_copy(tensor: Tensor) -> Any:
    """A copy, which may be changed."""
    return tensor.detach().clone(memory_format=torch.contiguous_format).numpy()


def as_grid(rows: Array, shape: tuple[int, ...]) -> Tensor:
    """Rows (B, size, C), one for each node, as a tensor (B, C, *S) of the same memory."""
    return torch.from_numpy(rows.reshape(len(rows), *shape, rows.shape[2])).movedim(-1, 1)


def material_rows(material: Tensor, materials: int) -> Any:
    """(B, N) indices; (B, 0) where there is only one material."""
    return as_array(material) if materials > 1 else np.empty((len(material), 0), np.int64)


def check_materials(parameters: KernelParameters, material: Array) -> None:
    """Raise IndexError if an index of `material_rows` is none of the scene's materials."""
    if material.size and not (material.min() >= 0 and material.max() < len(parameters.mass)):
        raise IndexError(f"A particle's material is not an index from 0 to {len(parameters.mass) - 1}.")


class ArrayCache:
    """Arrays of a rollout's tensors by name, made anew where a name stands for another tensor.

    Converting a tensor takes as long as a kernel on a small scene. Arrays share the tensors' memory, so that changes in
    place are seen; copies of tensors that are not contiguous are not kept.
    """

    def __init__(self) -> None:
        self._kept: dict[str, tuple[Tensor, int, Any]] = {}

    def array(self, name: str, tensor: Tensor) -> Any:
        """The tensor as an array, which must not be changed."""
        kept = self._kept.get(name)
        address = tensor.data_ptr()
        if kept is not None and kept[0] is tensor and kept[1] == address:
            return kept[2]
        array = as_array(tensor)
        if array.ctypes.data == address:
            self._kept[name] = (tensor, address, array)
        return array
