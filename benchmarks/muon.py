"""Muon for configurations: orthogonalised steps for convolutions, AdamW for all other weights.

Run with this folder on PYTHONPATH. Source: K. Jordan et al., Muon, 2024, as implemented by `pytorch_optimizer`, which
reshapes a convolution's weight to a matrix with a row per output channel.
"""

from __future__ import annotations

from collections.abc import Iterable

from pytorch_optimizer import Muon
from torch import Tensor


class ConvolutionMuon(Muon):
    """Muon for weights with three and more axes, AdamW for the others.

    Args:
        params: The network's parameters.
        lr: Learning rate of Muon.
        adamw_lr: Learning rate of AdamW.
    """

    def __init__(self, params: Iterable[Tensor], lr: float = 0.02, adamw_lr: float = 1.5e-3) -> None:
        found = list(params)
        groups = [
            {"params": [p for p in found if p.dim() > 2], "use_muon": True},
            {"params": [p for p in found if p.dim() <= 2], "use_muon": False},
        ]
        super().__init__(groups, lr=lr, adamw_lr=adamw_lr, use_adjusted_lr=True)
