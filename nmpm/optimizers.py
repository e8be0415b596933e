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
        """As `pytorch_optimizer`'s, to rounding; weights of one shape are computed together."""
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
        states, gradients = [self.state[weight] for weight in weights], [weight.grad for weight in weights]
        if self.defaults["record"] and _can_record(group):
            recorded = self._moves.get(number)
            if recorded is None or not recorded.are_of(states):
                recorded = self._moves[number] = _RecordedMoves(weights, states, group)
            moves = recorded(gradients)
        else:
            moves = _find_moves(gradients, states, group)
        step, (beta1, beta2) = group["step"] - 1, group["betas"]
        size = group["lr"] * (math.sqrt(self.debias(beta2, step)) / self.debias(beta1, step))
        torch._foreach_add_(weights, moves, alpha=-size)
        torch._foreach_mul_(weights, 1.0 - group["weight_decay"] * group["lr"])
        if step % group["precondition_frequency"] == 0:
            _change_bases(states)


def _find_moves(
    gradients: Sequence[Tensor], states: Sequence[dict[str, Any]], group: Mapping[str, Any]
) -> list[Tensor]:
    """How far weights move down at a learning rate of 1; updates the averages in their states."""
    (beta1, beta2), moves = group["betas"], list(gradients)
    means, squares = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq"))
    torch._foreach_lerp_(means, moves, 1.0 - beta1)
    for rows in _of_one_shape(gradients):
        alike, shape = [states[row] for row in rows], gradients[rows[0]].shape
        gradient, mean, square = (_stack([each[row] for row in rows]) for each in (gradients, means, squares))
        bases = _stack_bases(alike, shape)
        square.lerp_(_project(gradient, bases).square_(), 1.0 - beta2)
        torch._foreach_copy_([squares[row] for row in rows], _unstack(square, shape))
        move = _project(mean, bases).div_(square.sqrt_().add_(group["eps"]))
        move = _project(move, [basis if basis is None else basis.mT for basis in bases])
        for row, values in zip(rows, _unstack(move, shape), strict=True):
            moves[row] = values
        _average_products(gradient, alike, shape)
    return moves


def _of_one_shape(tensors: Sequence[Tensor]) -> list[list[int]]:
    """Indices of tensors, those of each shape together."""
    rows: dict[torch.Size, list[int]] = {}
    for row, tensor in enumerate(tensors):
        rows.setdefault(tensor.shape, []).append(row)
    return list(rows.values())


def _stack(weights: Sequence[Tensor]) -> Tensor:
    """(n, K, O, I) of n weights (O, I, k_1, …) with a kernel of K cells; axes that weights lack have one element."""
    shape = weights[0].shape
    rows = torch.stack([weight.movedim((0, 1), (-2, -1)) if len(shape) > 2 else weight for weight in weights])
    return rows.reshape(len(rows), math.prod(shape[2:]), *(shape[:1] or (1,)), *(shape[1:2] or (1,)))


def _unstack(values: Tensor, shape: torch.Size) -> list[Tensor]:
    """The n weights, of one shape, that `_stack` has made values of."""
    if len(shape) < 3:
        return list(values.reshape(len(values), *shape))
    return list(values.reshape(len(values), *shape[2:], *shape[:2]).movedim((-2, -1), (1, 2)))


def _stack_bases(states: Sequence[dict[str, Any]], shape: torch.Size) -> list[Tensor | None]:
    """(n, d, d) bases of n weights of one shape along outputs, inputs and the kernel's cells; None for their own."""
    axes = [torch.stack(axis) if len(axis[0]) else None for axis in zip(*(state["Q"] for state in states), strict=True)]
    kernel = None
    for basis, length in zip(axes[2:], shape[2:], strict=True):
        if length == 1:  # a sign, which cancels
            continue
        if basis is None:
            basis = torch.eye(length, device=states[0]["exp_avg"].device).expand(len(states), -1, -1)
        if kernel is not None:
            both = kernel[:, :, None, :, None] * basis[:, None, :, None]
            basis = both.flatten(3).flatten(1, 2)
        kernel = basis
    outputs, inputs = (*axes, None, None)[:2]
    return [outputs, inputs, kernel]


def _project(values: Tensor, bases: Sequence[Tensor | None]) -> Tensor:
    """Values (n, K, O, I) of n weights in the bases of `_stack_bases`."""
    outputs, inputs, kernel = bases
    if inputs is not None:
        values = (values.flatten(1, 2) @ inputs).view_as(values)
    if outputs is not None:
        values = outputs.mT.unsqueeze(1) @ values
    return values if kernel is None else (kernel.mT @ values.flatten(2)).view_as(values)


def _average_products(gradients: Tensor, states: Sequence[dict[str, Any]], shape: torch.Size) -> None:
    """Add the gradients (n, K, O, I) of n weights of one shape to the averages of their products along each axis."""
    kernel, letters = None, "abcdefg"[: len(shape[2:])]
    for axis, averages in enumerate(zip(*(state["GG"] for state in states), strict=True)):
        if not len(averages[0]):
            continue
        if axis == 0:
            products = (gradients @ gradients.mT).sum(1)
        elif axis == 1:
            products = gradients.flatten(1, 2).mT @ gradients.flatten(1, 2)
        else:
            if kernel is None:
                kernel = gradients.flatten(2) @ gradients.flatten(2).mT
                kernel = kernel.unflatten(2, shape[2:]).unflatten(1, shape[2:])
            this = letters[axis - 2]
            products = torch.einsum(f"n{letters}{letters.replace(this, 'z')}->n{this}z", kernel)
        torch._foreach_lerp_(averages, products.unbind(0), 1.0 - states[0]["shampoo_beta"])


def _change_bases(states: Sequence[dict[str, Any]]) -> None:
    """Turn weights' bases, in the memory that they have, by a power iteration and a QR decomposition."""
    for rows in _of_one_shape([state["exp_avg_sq"] for state in states]):
        alike = [states[row] for row in rows]
        squares = torch.stack([state["exp_avg_sq"] for state in alike])
        for axis, bases in enumerate(zip(*(state["Q"] for state in alike), strict=True)):
            if not len(bases[0]):
                continue
            basis = torch.stack(bases)
            products = torch.stack([state["GG"][axis] for state in alike]) @ basis
            order = (basis * products).sum(1).argsort(dim=1, descending=True)
            along = order.view(len(order), *(-1 if d == axis else 1 for d in range(squares.dim() - 1)))
            squares = squares.gather(axis + 1, along.expand_as(squares))
            turned = torch.linalg.qr(products.gather(2, order.unsqueeze(1).expand_as(products)))[0]
            torch._foreach_copy_(bases, turned.unbind(0))
        torch._foreach_copy_([state["exp_avg_sq"] for state in alike], squares.unbind(0))


class _RecordedMoves:
    """`_find_moves`, recorded for copies of gradients.

    Where recording fails, this is said once, and moves are computed operation by operation.
    """

    def __init__(self, weights: Sequence[Tensor], states: Sequence[dict[str, Any]], group: Mapping[str, Any]) -> None:
        self._states, self._group = states, {"betas": group["betas"], "eps": group["eps"]}
        self._moves = [torch.zeros_like(weight) for weight in weights]
        self._gradients = [torch.zeros_like(move) for move in self._moves]
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
        torch._foreach_copy_(self._moves, _find_moves(self._gradients, self._states, self._group))


def _can_record(group: Mapping[str, Any]) -> bool:
    """Whether the steps of a group of weights can be recorded: not if each changes the basis."""
    return all(map(is_on_gpu, group["params"])) and group["precondition_frequency"] > 1


def is_on_gpu(weight: Tensor) -> bool:
    """Whether a weight is on a CUDA GPU."""
    return weight.is_cuda
