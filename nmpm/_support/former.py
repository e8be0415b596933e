"""Names of version 0.1 that configurations, command lines and checkpoints may hold. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

LOSS_OPTIONS: Mapping[str, str] = MappingProxyType(
    {"error_power": "power", "density_weight": "density_weight", "field_weight": "field_weight"}
)
"""Options of the model that are those of its loss by now."""


def with_loss(model: Mapping[str, Any]) -> dict[str, Any]:
    """A model's plain arguments, with former options of the loss among the arguments of `loss`."""
    options = {name: model[former] for former, name in LOSS_OPTIONS.items() if former in model}
    rest = {name: value for name, value in model.items() if name not in LOSS_OPTIONS}
    if not options:
        return rest
    loss = {"class_path": "nmpm.training.losses.PositionLoss"} | (rest.get("loss") or {})
    return rest | {"loss": loss | {"init_args": options | (loss.get("init_args") or {})}}
