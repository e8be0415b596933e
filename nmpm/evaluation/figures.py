"""Figures of a model and of the trivial predictors, by name, as reports and cards show them. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

PREDICTORS: Mapping[str, str] = MappingProxyType(
    {"model": "model", "still": "nothing moves", "free_fall": "free fall, stopped at walls"}
)
"""What is compared, and its name in tables. Figures of all but the model have the key and a slash before their name."""


def figure_names(figures: Mapping[str, float]) -> list[str]:
    """Names of the model's figures: MSE at horizons in order, the full rollout's after them, then the rest."""
    names = [name for name in figures if "/" not in name]
    return sorted(names, key=lambda name: (not name.startswith("mse"), "@" not in name, _horizon(name)))


def table_row(figures: Mapping[str, float], kind: str) -> list[str]:
    """A predictor's figures ×10⁻³, in the order of `figure_names`; empty where it has none."""
    prefix = "" if kind == "model" else f"{kind}/"
    return [f"{1e3 * figures[prefix + n]:.4g}" if prefix + n in figures else "" for n in figure_names(figures)]


def no_better_than_trivial(figures: Mapping[str, float]) -> str:
    """Says so in words where a model's full rollouts are not better than a trivial predictor's; else empty."""
    trivial = {kind: figures[f"{kind}/mse"] for kind in PREDICTORS if f"{kind}/mse" in figures}
    best = min(trivial, key=trivial.__getitem__, default=None)
    if best is None or figures["mse"] < trivial[best]:  # NaN is not
        return ""
    return (
        f"The model is no better than a trivial predictor: its error is {1e3 * figures['mse']:.3g}e-3, that of"
        f" '{PREDICTORS[best]}' {1e3 * trivial[best]:.3g}e-3. Train it longer, or on more data, before using it."
    )


def _horizon(name: str) -> int:
    return int(name.partition("@")[2] or 0)
