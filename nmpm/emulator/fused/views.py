"""Tensors that stay the same through a rollout, as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor


def as_array(tensor: Tensor) -> Any:
    """The tensor's memory; a copy where it is not contiguous."""
    return np.ascontiguousarray(tensor.detach().numpy())


class Views:
    """Arrays of a rollout's tensors by name, made anew where a name stands for another tensor.

    Converting a tensor takes as long as a kernel on a small scene. Arrays share the tensors' memory, so that changes in
    place are seen; what had to be copied is not kept.
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
