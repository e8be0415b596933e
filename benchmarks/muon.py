"""Muon as a configuration can name it: orthogonalised steps for the convolutions, AdamW for all else.

Needs `pip install pytorch-optimizer`; run with this folder on PYTHONPATH. Source: K. Jordan et al., Muon, 2024, by way
of that package, which flattens a convolution's weight to a matrix of its output channels.
"""

from __future__ import annotations

from collections.abc import Iterable

from pytorch_optimizer import Muon
from torch import Tensor


class ConvolutionMuon(Muon):  # type: ignore[misc]  # (a package that is not installed)
    """Muon for weights of three and more axes.

    Args:
        params: Of a network.
        lr: Of Muon.
        adamw_lr: Of AdamW.
    """

    def __init__(self, params: Iterable[Tensor], lr: float = 0.02, adamw_lr: float = 1.5e-3) -> None:
        found = list(params)
        groups = [
            {"params": [p for p in found if p.dim() > 2], "use_muon": True},
            {"params": [p for p in found if p.dim() <= 2], "use_muon": False},
        ]
        super().__init__(groups, lr=lr, adamw_lr=adamw_lr, use_adjusted_lr=True)
