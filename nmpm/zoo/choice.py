"""Choose among the variants of a model by error and time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

from nmpm.errors import ConfigError, ZooError
from nmpm.zoo.card import stated_error, stated_milliseconds


@dataclass(frozen=True)
class Limits:
    """What a chosen model must keep to, and whose times count.

    Args:
        max_mse: Largest full-rollout MSE on the test scenes, in length².
        max_ms_per_frame: Largest time per frame of one scene.
        hardware: Whose stated times count; those of this machine when left out.
        calibrate: Whether the variants are timed now instead.

    Raises:
        ConfigError: if a limit is not a positive number, or whose times count is ambiguous or of no use.
    """

    max_mse: float | None = None
    max_ms_per_frame: float | None = None
    hardware: str | None = None
    calibrate: bool = False

    def __post_init__(self) -> None:
        for name in ("max_mse", "max_ms_per_frame"):
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, Real) or not float(value) > 0):
                raise ConfigError(f"{name} = {value!r} must be a positive number, or be left out.")
        if not self and (self.calibrate or self.hardware is not None):
            raise ConfigError("calibrate and hardware are of use with a limit: give max_mse or max_ms_per_frame too.")
        if self.calibrate and self.hardware is not None:
            raise ConfigError(
                f"calibrate times the models here, hardware = {self.hardware!r} takes stated times: give one."
            )

    def __bool__(self) -> bool:
        return self.max_mse is not None or self.max_ms_per_frame is not None


def choose(cards: Mapping[str, Mapping[str, Any]], limits: Limits, times: Mapping[str, float]) -> str:
    """The model within the limits: the most accurate if time is limited, else the fastest, else the most accurate.

    Models whose cards state no error are left out; so are those of unknown times where the others' are known.

    Args:
        cards: Of the variants, by name.
        limits: What it must keep to.
        times: Milliseconds per frame, of the variants of which they are known.

    Raises:
        ZooError: if none is within the limits, or times are needed of which none is known.
    """
    errors = {name: mse for name, card in cards.items() if (mse := stated_error(card)) is not None}
    if limits.max_ms_per_frame is not None and errors and not times:
        hardware = sorted({hardware for name in errors for hardware in stated_milliseconds(cards[name])})
        elsewhere = f", but on {'; '.join(hardware)} (hardware=…)" if hardware else ""
        raise ZooError(
            f"The cards of {', '.join(sorted(errors))} state no time on {limits.hardware or 'this machine'}{elsewhere}."
            " Give calibrate=True to time them here."
        )
    accurate = [name for name, mse in errors.items() if limits.max_mse is None or mse <= limits.max_mse]
    timed = [name for name in accurate if name in times]
    if limits.max_ms_per_frame is not None:
        within = [name for name in timed if times[name] <= limits.max_ms_per_frame]
    else:
        within = timed or accurate
    if not within:
        figures = "; ".join(
            f"{name}: MSE {mse:.3g}" + (f", {times[name]:.3g} ms" if name in times else "")
            for name, mse in errors.items()
        )
        raise ZooError(f"No model is within the limits. {figures or 'None states an error.'}")
    by_time = limits.max_ms_per_frame is None and bool(timed)
    return min(within, key=times.__getitem__ if by_time else errors.__getitem__)
