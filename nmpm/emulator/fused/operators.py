"""The kernels as operators of torch, `torch.ops.nmpm.*`, which torch.compile and torch.export pass on as they are.

They have no gradients and run on the CPU. Outside of such graphs `nmpm.emulator.fused.direct` calls the kernels, as
torch's dispatcher takes as long as a kernel does on a small scene.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nmpm.emulator.fused import calls
from nmpm.emulator.fused.plan import Plan, read_plan

_LIBRARY = torch.library.Library("nmpm", "DEF")
_TAGS = (torch.Tag.needs_exact_strides,)
_LIBRARY.define(
    "rasterise(str plan, Tensor position, Tensor velocity, Tensor gravity, Tensor material, Tensor mask, Tensor solid)"
    " -> (Tensor, Tensor, Tensor, Tensor)",
    tags=_TAGS,
)
_LIBRARY.define(
    "predict_path(str plan, Tensor cells, Tensor velocity, Tensor gravity, Tensor material, Tensor mask, Tensor state,"
    " Tensor output, Tensor scale, Tensor solid, Tensor walls, Tensor? budget) -> Tensor",
    tags=_TAGS,
)
_LIBRARY.define(
    "uncrowd(str plan, Tensor cells, Tensor gravity, Tensor material, Tensor mask, Tensor path, Tensor solid,"
    " Tensor walls, Tensor? budget) -> Tensor",
    tags=_TAGS,
)


def rasterise(plan: Plan, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`calls.rasterise` as an operator."""
    here, velocity, gravity, state = torch.ops.nmpm.rasterise(plan.to_text(), *tensors)
    return here, velocity, gravity, state


def predict_path(plan: Plan, *tensors: Tensor | None) -> Tensor:
    """`calls.predict_path` as an operator."""
    path: Tensor = torch.ops.nmpm.predict_path(plan.to_text(), *tensors)
    return path


def uncrowd(plan: Plan, *tensors: Tensor | None) -> Tensor:
    """`calls.uncrowd` as an operator."""
    path: Tensor = torch.ops.nmpm.uncrowd(plan.to_text(), *tensors)
    return path


def to_length(plan: Plan, path: Tensor) -> Tensor:
    """`calls.to_length`, as tensor operations, which compilers fuse by themselves."""
    return path * path.new_tensor(plan.spacing) + path.new_tensor(plan.lower)


def _rasterise(plan: str, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return calls.rasterise(read_plan(plan), *tensors)


def _predict_path(plan: str, *tensors: Any) -> Tensor:
    return calls.predict_path(read_plan(plan), *tensors)


def _uncrowd(plan: str, *tensors: Any) -> Tensor:
    return calls.uncrowd(read_plan(plan), *tensors)


def _fake_rasterise(plan: str, position: Tensor, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    known = read_plan(plan)
    batch, dim = len(position), known.dim
    state = position.new_empty(batch, *known.shape, known.channels).movedim(-1, 1)
    return torch.empty_like(position), torch.empty_like(tensors[0]), position.new_empty(batch, 1, dim), state


def _fake_path(plan: str, cells: Tensor, *tensors: Tensor) -> Tensor:  # noqa: ARG001
    return cells.new_empty(len(cells), tensors[5].shape[1], *cells.shape[1:])


def _fake_spread(plan: str, *tensors: Tensor) -> Tensor:  # noqa: ARG001
    return tensors[4].new_empty(tensors[4].shape)


_LIBRARY.impl("rasterise", _rasterise, "CPU")
_LIBRARY.impl("predict_path", _predict_path, "CPU")
_LIBRARY.impl("uncrowd", _uncrowd, "CPU")
torch.library.register_fake("nmpm::rasterise", _fake_rasterise, lib=_LIBRARY)
torch.library.register_fake("nmpm::predict_path", _fake_path, lib=_LIBRARY)
torch.library.register_fake("nmpm::uncrowd", _fake_spread, lib=_LIBRARY)
