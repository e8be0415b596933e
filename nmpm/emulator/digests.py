"""Digests of weights, by which a file whose bytes have changed is noticed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and bytes of tensors, in the order of their names."""
    digest = hashlib.sha256()
    for name, values in sorted(weights.items()):
        digest.update(f"{name} {values.dtype} {tuple(values.shape)};".encode())
        digest.update(values.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def float32_digest(weights: Mapping[str, Tensor]) -> str:
    """`weights_digest` in float32: the same after a test in another precision than the training's."""
    return weights_digest({k: v.float() if v.is_floating_point() else v for k, v in weights.items()})
