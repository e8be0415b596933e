"""Optimizers that take fewer steps than Adam to the same error."""

from __future__ import annotations

from collections.abc import Iterable

import pytorch_optimizer
from torch import Tensor

from nmpm.errors import ConfigError


class SOAP(pytorch_optimizer.SOAP):
    """Adam in the eigenbasis of Shampoo's preconditioner, by `pytorch_optimizer`, with defaults for grid networks.

    Source: N. Vyas et al., SOAP: Improving and Stabilizing Shampoo using Adam, arXiv 2409.11321. Compared with Adam
    in `docs/recipes.md`.

    Args:
        params: Of an emulator.
        lr: Learning rate.
        weight_decay: Decoupled, as in AdamW.
        max_precondition_dim: Axes of weights that are longer keep their own basis.
        precondition_frequency: Steps between changes of basis.

    Raises:
        ConfigError: if the learning rate is not positive, or weights are complex.
    """

    def __init__(
        self, params: Iterable[Tensor], lr: float = 3e-3, weight_decay: float = 0.01, max_precondition_dim: int = 600,
        precondition_frequency: int = 10,
    ) -> None:  # fmt: skip
        if not lr > 0:
            raise ConfigError(f"SOAP: lr = {lr} must be a positive number.")
        weights = list(params)
        if any(weight.is_complex() for weight in weights):
            raise ConfigError(
                "SOAP cannot train complex weights, such as FNO's: --model.optimizer torch.optim.Adam"
                " --model.optimizer.lr 1.5e-3."
            )
        super().__init__(
            weights, lr=lr, weight_decay=weight_decay, max_precondition_dim=max_precondition_dim,
            precondition_frequency=precondition_frequency,
        )  # fmt: skip
