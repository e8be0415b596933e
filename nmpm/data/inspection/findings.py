"""Findings about a dataset: contradictions, oddities and notes, one line per kind, worst first."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum


class Severity(StrEnum):
    """How bad a finding is, worst first."""

    CONTRADICTION = "contradiction"  # a model that trusts the data becomes wrong
    ODDITY = "oddity"  # it may
    NOTE = "note"  # it does not


@dataclass(frozen=True)
class Finding:
    """Something to know about a dataset, or about one of its trajectories."""

    kind: str  # what it is about, e.g. "gravity" or "jumps"; findings of a kind are shown in one line
    severity: Severity
    sentence: str  # what is wrong and how to mend it
    where: str = ""  # the trajectory, e.g. "train 00003"; empty if it is about the dataset
    details: str = ""  # where in the trajectory, e.g. "frame 12, particle 5"
    factor: float | None = None  # by how much a stated value is too large, or a measured one
    badness: float = 0.0  # orders findings of a kind

    def __str__(self) -> str:
        return ": ".join(filter(None, (self.kind, ", ".join(filter(None, (self.where, self.details))), self.sentence)))


def sort_findings(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The same findings, contradictions first and notes last."""
    return tuple(sorted(findings, key=lambda finding: list(Severity).index(finding.severity)))


def merge_findings(findings: Iterable[Finding], trajectories: int) -> tuple[Finding, ...]:
    """One finding of each kind, of the worst trajectory, that says in how many of `trajectories` it is; worst first."""
    kinds: dict[tuple[str, Severity], list[Finding]] = {}
    for finding in findings:
        kinds.setdefault((finding.kind, finding.severity), []).append(finding)
    return sort_findings(_merge(group, trajectories) for group in kinds.values())


def _merge(group: list[Finding], trajectories: int) -> Finding:
    worst = max(group, key=lambda finding: finding.badness)
    if not worst.where:
        more = f" … and {len(group) - 1} more." if len(group) > 1 else ""
        return replace(worst, sentence=worst.sentence + more)
    count = len({finding.where for finding in group})
    many = f"in {count} of {trajectories} trajectories, worst in " if trajectories > 1 else ""
    return replace(worst, where=many + worst.where)
