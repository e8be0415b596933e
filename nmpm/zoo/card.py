"""The content of `card.yaml`, and what follows from its figures: lifecycle, intervals, and the row of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from nmpm._support.numbers import is_number
from nmpm.evaluation.bootstrap import interval

CARD = "card.yaml"
FORMAT = 1
"""Version of the layout of `card.yaml` and of the files beside it."""
Lifecycle = Literal["active", "preview"]
FACTOR = 4.0
"""How much lower than the better trivial predictor's a model's full-rollout MSE must be, to be more than a preview."""
SIMULATED = ", simulated by nmpm"
"""What follows a preset's name in the description of its dataset."""
USUAL = "eager float32"
"""The runtime and precision of a model as it is loaded."""
Interval = tuple[float, float]


def preset_of(card: Mapping[str, Any]) -> str | None:
    """Name of the simulator preset that made the data of a card; None for recorded or unknown data."""
    name, simulated, _ = str(card.get("dataset", "")).partition(SIMULATED)
    return name if simulated else None


def lifecycle(card: Mapping[str, Any]) -> Lifecycle:
    """The state of a model: active, or a preview.

    A preview's full-rollout error is not `FACTOR` times lower than a trivial predictor's, or not measured beside one.
    """
    test = card.get("test")
    figures = test if isinstance(test, Mapping) else {}
    mse, trivial = figures.get("mse"), [figures.get(f"{kind}/mse") for kind in ("still", "free_fall")]
    known = [value for value in trivial if is_number(value)]
    return "active" if is_number(mse) and known and FACTOR * mse <= min(known) else "preview"


def intervals(rows: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """The 95% interval of each figure's mean over test scenes, for those that every scene has; empty for one scene."""
    names = [name for name in (rows[0] if len(rows) > 1 else ()) if all(name in row for row in rows)]
    return {name: list(interval([row[name] for row in rows])) for name in names}


def stress_digest(report: Mapping[str, Any]) -> dict[str, Any]:
    """A summary of a report of `nmpm stress`: its size, how many lines passed, and which failed."""
    lines = report["lines"]
    return {
        "size": report["size"],
        "passed": sum(line["passed"] is True for line in lines),
        "failed": [f"{line['group']}: {line['name']}" for line in lines if line["passed"] is False],
    }


@dataclass(frozen=True)
class TableRow:
    """The figures of a model in a table of accuracy and speed; None where they are not measured.

    Errors are mean squared, over the test scenes, in domain length squared: over the first 100 frames and over full
    rollouts.

    Args:
        name: Of the model.
        state: "active" or "preview".
        dataset: In words.
        mse_100, mse: Errors.
        interval_100, interval: 95% intervals of these means over test scenes.
        twin_100, twin: Errors of the simulator with other substeps, mostly half as many.
        floor_100, floor: Errors of the simulator started from positions that differ by 10⁻⁶ of the domain: no
            prediction gets below them.
        trivial: Full-rollout error of the better trivial predictor: nothing moves, or free fall.
        hours: Of training.
        milliseconds: Per frame of one scene, by hardware, and runtime where that is not the usual one: "NVIDIA H200".
        speed_up: Time of the cheapest simulator setting that is no less accurate, over that of the model.
    """

    name: str
    state: Lifecycle
    dataset: str
    mse_100: float | None
    mse: float | None
    interval_100: Interval | None
    interval: Interval | None
    twin_100: float | None
    twin: float | None
    floor_100: float | None
    floor: float | None
    trivial: float | None
    hours: float | None
    milliseconds: Mapping[str, float]
    speed_up: float | None

    @property
    def twins(self) -> float | None:
        """The full-rollout error over that of the simulator with other substeps."""
        return self.mse / self.twin if self.mse is not None and self.twin else None


def table_row(card: Mapping[str, Any]) -> TableRow:
    """The row of a card in a table of accuracy and speed.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: if the card is malformed.
    """
    test, twin, floor, ends = (card.get(key) or {} for key in ("test", "twin", "floor", "interval"))
    trivial = [float(test[key]) for key in ("still/mse", "free_fall/mse") if key in test]
    seconds = (card.get("training") or {}).get("seconds")
    trade = card.get("trade") or {}
    return TableRow(
        name=str(card["name"]),
        state=lifecycle(card),
        dataset=str(card.get("dataset", "")),
        mse_100=_number(test, "mse@100"),
        mse=_number(test, "mse"),
        interval_100=_ends(ends, "mse@100"),
        interval=_ends(ends, "mse"),
        twin_100=_number(twin, "mse@100"),
        twin=_number(twin, "mse"),
        floor_100=_number(floor, "mse@100"),
        floor=_number(floor, "mse"),
        trivial=min(trivial, default=None),
        hours=None if seconds is None else seconds / 3600,
        milliseconds={
            time["hardware"] + ("" if time["runtime"] == USUAL else f", {time['runtime']}"): float(time["ms_per_frame"])
            for time in [*(card.get("speed") or []), *trade.get("times", [])]
        },
        speed_up=_number(trade, "speed_up"),
    )


def _number(figures: Mapping[str, Any], name: str) -> float | None:
    return float(figures[name]) if name in figures else None


def _ends(ends: Mapping[str, Any], name: str) -> Interval | None:
    return (float(ends[name][0]), float(ends[name][1])) if name in ends else None
