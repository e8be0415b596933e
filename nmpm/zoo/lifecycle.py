"""The lifecycle of a zoo model (active, preview or superseded), derived from its card's figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

Lifecycle = Literal["active", "preview", "superseded"]
STATES: tuple[Lifecycle, ...] = get_args(Lifecycle)
FACTOR = 4.0
"""How much lower than the better trivial predictor's a model's full-rollout MSE must be, to be more than a preview."""
CARD_FORMAT = 1
"""Version of the layout of `card.yaml`."""


def lifecycle(card: Mapping[str, Any]) -> Lifecycle:
    """The state of a model.

    Args:
        card: Content of `card.yaml`. With the key `superseded_by`, the name of a better model, it is superseded.

    Returns:
        "active"; or "preview" for a model whose error is not `FACTOR` times lower than a trivial predictor's, or is
        not measured beside one.
    """
    if card.get("superseded_by"):
        return "superseded"
    test = card.get("test")
    figures = test if isinstance(test, Mapping) else {}
    trivial = [figures.get(f"{kind}/mse") for kind in ("still", "free_fall")]
    known = [value for value in trivial if isinstance(value, int | float)]
    mse = figures.get("mse")
    measured = isinstance(mse, int | float) and bool(known)
    return "active" if measured and FACTOR * float(mse) <= min(known) else "preview"  # type: ignore[arg-type]  # (a number)
