"""Findings about a dataset: contradictions, oddities and notes, one line per kind, worst first."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any


class Severity(StrEnum):
    """How bad a finding is, worst first."""

    CONTRADICTION = "contradiction"  # a model that trusts the data becomes wrong
    ODDITY = "oddity"  # it may
    NOTE = "note"  # it does not


@dataclass(frozen=True)
class Finding:
    """Something to know about a dataset, or about one of its trajectories.

    Args:
        kind: What it is about, e.g. "gravity" or "jumps"; findings of a kind are shown in one line.
        severity: How bad it is.
        sentence: What is wrong and how to mend it.
        where: The trajectory, e.g. "train 00003"; empty if it is about the dataset.
        details: Where in the trajectory, e.g. "frame 12, particle 5".
        factor: By how much a stated value is too large, or a measured one; None where there is no such number.
        badness: Orders findings of a kind, the larger the worse.
    """

    kind: str
    severity: Severity
    sentence: str
    where: str = ""
    details: str = ""
    factor: float | None = None
    badness: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """The finding as plain strings and numbers."""
        return {name: value for name, value in vars(self).items() if name != "badness"}


_ORDER = tuple(Severity)


def merge_findings(findings: Iterable[Finding], trajectories: int) -> tuple[Finding, ...]:
    """One finding per kind and severity, worst first, which says where in how many of the `trajectories` it is worst.

    Findings about the dataset, without a trajectory, stay as they are.
    """
    groups: dict[tuple[str, Severity], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.kind, finding.severity), []).append(finding)
    merged = [
        merged
        for group in groups.values()
        for merged in ([f for f in group if not f.where] or [_merge([f for f in group if f.where], trajectories)])
    ]
    return tuple(sorted(merged, key=lambda finding: _ORDER.index(finding.severity)))


def _merge(group: list[Finding], trajectories: int) -> Finding:
    worst = max(group, key=lambda finding: finding.badness)
    count = len({finding.where for finding in group})
    many = f"in {count} of {trajectories} trajectories, worst in " if trajectories > 1 else ""
    details = f", {worst.details}" if worst.details else ""
    return replace(worst, sentence=f"{many}{worst.where}{details}: {worst.sentence}")
