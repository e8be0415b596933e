"""Choose among the variants of a model by what their cards say of error and time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nmpm._support.devices import same_hardware
from nmpm.errors import ZooError


@dataclass(frozen=True)
class Limits:
    """What a chosen model must keep to.

    Args:
        max_mse: Largest full-rollout MSE on the test scenes, in length².
        max_ms_per_frame: Largest time per frame of one scene.
        hardware: Whose times count, as cards name it; those of this machine when left out.
    """

    max_mse: float | None = None
    max_ms_per_frame: float | None = None
    hardware: str | None = None

    def __bool__(self) -> bool:
        return self.max_mse is not None or self.max_ms_per_frame is not None


def choose(cards: Mapping[str, Mapping[str, Any]], limits: Limits, milliseconds: Callable[[str], float | None]) -> str:
    """The model within the limits: the most accurate if time is limited, else the fastest, else the most accurate.

    Args:
        cards: Of the variants, by name.
        limits: What it must keep to.
        milliseconds: The time per frame of a model of that name; None where it is not known.

    Raises:
        ZooError: if none is within the limits, or times are needed that are not known.
    """
    errors = {name: float(card["test"]["mse"]) for name, card in cards.items() if "mse" in (card.get("test") or {})}
    times = {name: milliseconds(name) for name in errors}
    unknown = sorted(name for name, time in times.items() if time is None)
    if limits.max_ms_per_frame is not None and unknown:
        where = limits.hardware or "this machine"
        raise ZooError(
            f"The cards of {', '.join(unknown)} state no time on {where}{_measured(cards, unknown)}. Give"
            " calibrate=True to time them here."
        )
    most, slowest = (limits.max_mse or float("inf")), (limits.max_ms_per_frame or float("inf"))
    within = [n for n, mse in errors.items() if mse <= most and (times[n] is None or times[n] <= slowest)]  # type: ignore[operator]
    if not within:
        found = "; ".join(
            f"{name}: MSE {mse:.3g}" + ("" if times[name] is None else f", {times[name]:.3g} ms")
            for name, mse in errors.items()
        )
        raise ZooError(f"No model is within the limits. {found or 'None states an error.'}")
    by_time = limits.max_ms_per_frame is None and not unknown
    return min(within, key=lambda name: times[name] if by_time else errors[name])  # type: ignore[arg-type,return-value]


def stated_milliseconds(card: Mapping[str, Any], hardware: str) -> float | None:
    """The time per frame that a card states for a hardware; None where it states none."""
    entries: Sequence[Mapping[str, Any]] = card.get("speed") or ()
    own = [entry for entry in entries if same_hardware(str(entry.get("hardware")), hardware)]
    return float(own[0]["ms_per_frame"]) if own else None


def _measured(cards: Mapping[str, Mapping[str, Any]], names: Sequence[str]) -> str:
    known = sorted({str(entry["hardware"]) for name in names for entry in cards[name].get("speed") or ()})
    return f", but on {'; '.join(known)} (hardware=…)" if known else ""
