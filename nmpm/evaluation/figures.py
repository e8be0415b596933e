"""Figures of a model and of the trivial predictors, by name, as reports and cards show them. Imports no torch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from statistics import median
from types import MappingProxyType
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.table import Table

PREDICTORS: Mapping[str, str] = MappingProxyType(
    {"model": "model", "still": "nothing moves", "free_fall": "free fall, stopped at walls"}
)
"""Predictors and their names in tables. Figures of all but the model have the key and a slash before their name."""


_LONGEST = 10**7
"""Figures of at least so many units are printed with an exponent."""


class Unit(NamedTuple):
    """A power of ten, of which all errors of a table or line are multiples."""

    exponent: int

    @classmethod
    def of(cls, values: Iterable[float]) -> Unit:
        """10⁻³, as in the paper, unless the median is at least 10 or under 10⁻⁶, as for data in millimetres."""
        sizes = [abs(value) for value in values if value and math.isfinite(value)]
        middle = median(sizes) if sizes else 1e-3
        return cls(-3 if 1e-6 <= middle < 10 else 3 * math.floor(math.log10(middle) / 3))

    def show(self, value: float, digits: int = 4) -> str:
        """The number of units, to so many significant digits."""
        count = value / 10.0**self.exponent
        whole = 10**digits - 0.5 <= abs(count) < _LONGEST
        return f"{count:.0f}" if whole else f"{count:.{digits}g}"

    def __str__(self) -> str:
        """With a space before it, such as " ×10⁻³"; empty for 1."""
        power = str(self.exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f" ×10{power}" if self.exponent else ""


def with_unit(value: float) -> str:
    """An error with its unit, to three digits, such as "0.164 ×10⁻³"."""
    unit = Unit.of([value])
    return f"{unit.show(value, 3)}{unit}"


def figures_unit(figures: Mapping[str, float]) -> Unit:
    """The unit of the figures of a model and of the trivial predictors."""
    # By how far things move, if that is known: a model may be nearly perfect, or diverge.
    scale = figures.get("still/mse")
    return Unit.of(figures.values() if scale is None else [scale])


def error_table(what: str, figures: Mapping[str, float], predictors: Mapping[str, str] = PREDICTORS) -> Table:
    """The errors of a model beside those of other predictors, in one unit, which the title names.

    MSE at horizons come in order, the full rollout's after them, then the rest.
    """
    names = [name for name in figures if "/" not in name]
    names.sort(key=lambda name: (not name.startswith("mse"), "@" not in name, int(name.partition("@")[2] or 0)))
    unit = figures_unit(figures)
    lengths = "MSE in length², EMD in length" if any(name.startswith("emd") for name in names) else "MSE in length²"
    table = Table(title=f"{what} error{unit} ({lengths})")
    table.add_column("predictor")
    for name in names:
        table.add_column(name, justify="right")
    for kind, label in predictors.items():
        prefix = "" if kind == "model" else f"{kind}/"
        row = [figures.get(prefix + name) for name in names]
        table.add_row(label, *("" if value is None else unit.show(value) for value in row))
    return table


def no_better_than_trivial(figures: Mapping[str, float]) -> str:
    """Says so in words where a model's full rollouts are not better than a trivial predictor's; else empty."""
    trivial = {kind: figures[f"{kind}/mse"] for kind in PREDICTORS if f"{kind}/mse" in figures}
    best = min(trivial, key=trivial.__getitem__, default=None)
    if best is None or figures["mse"] < trivial[best]:  # NaN is not
        return ""
    return (
        f"The model is no better than a trivial predictor: its error is {with_unit(figures['mse'])}, that of"
        f" '{PREDICTORS[best]}' {with_unit(trivial[best])}. Train it longer, or on more data, before using it."
    )


ENSEMBLE_COLUMNS = ("single", "members", "spread/skill", "in 50%", "in 90%")
"""Of the table of an ensemble's scores: two of the fair CRPS, spread over skill, coverage of central intervals."""


def ensemble_rows(ensemble: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Name and cells below `ENSEMBLE_COLUMNS` of each quantity and frame, of `EnsembleTest.to_dict`."""
    rows = []
    for name, scores in ensemble["scores"].items():
        low, high = (1e3 * value for value in scores["interval"])
        further = [scores.get(key) for key in ("spread_skill", "coverage50", "coverage90")]
        cells = [f"{1e3 * scores['single']:.3g}", f"{1e3 * scores['crps']:.3g} ({low:.3g}–{high:.3g})"]
        cells += ["" if value is None else f"{value:.2f}" for value in further]
        rows.append((name, cells))
    return rows


def ensemble_title(ensemble: Mapping[str, Any]) -> str:
    """What a table of scores shows, such as "fair CRPS ×10⁻³ of 8 members"."""
    nudged = f", starts displaced by {ensemble['nudge']:g} cells" if "nudge" in ensemble else ""
    return f"fair CRPS ×10⁻³ of {ensemble['members']} members{nudged}"


def ensemble_table(what: str, ensemble: Mapping[str, Any]) -> Table:
    """The scores of an ensemble beside those of one rollout."""
    table = Table(title=f"{what} {ensemble_title(ensemble)}", box=SIMPLE_HEAD)
    table.add_column("quantity")
    for name in ENSEMBLE_COLUMNS:
        table.add_column(name, justify="right", no_wrap=True)
    for name, cells in ensemble_rows(ensemble):
        table.add_row(name, *cells)
    return table
