"""Optimizers that take fewer steps than Adam to the same error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import pytorch_optimizer
import torch
from torch import Tensor

from nmpm.emulator.engines import graphs
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
        record: Whether a CUDA GPU records the operations of a step, some 25 for each weight, as a CUDA graph, but for
            changes of basis. Not tried on one yet.

    Raises:
        ConfigError: if the learning rate is not positive, or weights are complex.
    """

    def __init__(
        self, params: Iterable[Tensor], lr: float = 3e-3, weight_decay: float = 0.01, max_precondition_dim: int = 600,
        precondition_frequency: int = 10, record: bool = False,
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
        self.defaults["record"] = record  # (which copies keep)
        self._moves: dict[int, _RecordedMoves] = {}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._moves = {}  # copies record their own

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """As `pytorch_optimizer`'s, to the same bits."""
        if not (self.defaults["record"] and all(map(_can_record, self.param_groups))):
            return super().step(closure)
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for number, group in enumerate(self.param_groups):
            self.init_group(group)
            group["step"] += 1
            if group["step"] > 1 and any(weight.grad is not None for weight in group["params"]):
                self._move(number, group)
        return loss

    def _move(self, number: int, group: dict[str, Any]) -> None:
        """Move the weights of a group, which is the optimizer's `number`-th."""
        weights = [weight for weight in group["params"] if weight.grad is not None]
        states = [self.state[weight] for weight in weights]
        moves = self._moves.get(number)
        if moves is None or not moves.are_of(states):
            moves = self._moves[number] = _RecordedMoves(weights, states, group)
        step, (beta1, beta2) = group["step"] - 1, group["betas"]
        size = group["lr"] * (math.sqrt(self.debias(beta2, step)) / self.debias(beta1, step))
        torch._foreach_add_(weights, moves([weight.grad for weight in weights]), alpha=size)
        torch._foreach_mul_(weights, 1.0 - group["weight_decay"] * group["lr"])
        if step % group["precondition_frequency"] == 0:
            for state in states:
                self._change_basis(state, group["max_precondition_dim"])

    def _change_basis(self, state: dict[str, Any], max_precondition_dim: int) -> None:
        """Change the basis of a weight, in the memory that it has."""
        squares = state["exp_avg_sq"]
        changed = self.get_orthogonal_matrix_qr(state, max_precondition_dim)
        state["exp_avg_sq"] = squares.copy_(state["exp_avg_sq"])
        for basis, new in zip(state["Q"], changed, strict=True):
            if len(basis):
                basis.copy_(new)


class _RecordedMoves:
    """How weights move at a learning rate of 1, recorded for copies of their gradients.

    Where recording fails, this is said once, and moves are computed operation by operation.
    """

    def __init__(self, weights: Sequence[Tensor], states: Sequence[dict[str, Any]], group: Mapping[str, Any]) -> None:
        self._states = states
        self._moves = [torch.zeros_like(weight) for weight in weights]
        self._gradients = [torch.zeros_like(move) for move in self._moves]
        for move, gradient in zip(self._moves, self._gradients, strict=True):
            move.grad = gradient
        self._optimizer = pytorch_optimizer.SOAP(
            self._moves, lr=1.0, betas=group["betas"], weight_decay=0.0, correct_bias=False, eps=group["eps"],
            max_precondition_dim=group["max_precondition_dim"],
        )  # fmt: skip
        self._optimizer.state.update(zip(self._moves, states, strict=True))
        kept = [values for state in states for values in (state["exp_avg"], state["exp_avg_sq"], *state["GG"])]
        changing = [values for values in kept if len(values)]
        before = [values.clone() for values in changing]
        try:
            self._replay, _ = graphs.record(self._compute, weights[0].device)
        except Exception as failure:  # (of whatever an operation raises that cannot be recorded)
            graphs.warn_not_recorded("Steps of SOAP", failure)
            self._replay = self._compute
        torch._foreach_copy_(changing, before)  # recording has called it several times

    def are_of(self, states: Sequence[dict[str, Any]]) -> bool:
        """Whether these are the states that are recorded."""
        return len(states) == len(self._states) and all(map(lambda a, b: a is b, states, self._states))

    def __call__(self, gradients: Sequence[Tensor]) -> list[Tensor]:
        """The moves, in memory that is used again."""
        torch._foreach_copy_(self._gradients, list(gradients))
        self._replay()
        return self._moves

    @torch.no_grad()
    def _compute(self) -> None:
        torch._foreach_zero_(self._moves)
        self._optimizer.param_groups[0]["step"] = 1  # neither the first, nor one that changes the basis
        self._optimizer.step()


def _can_record(group: Mapping[str, Any]) -> bool:
    """Whether the steps of a group of weights can be recorded: not if each changes the basis."""
    return all(map(is_on_gpu, group["params"])) and group["precondition_frequency"] > 1


def is_on_gpu(weight: Tensor) -> bool:
    """Whether a weight is on a CUDA GPU."""
    return weight.is_cuda
