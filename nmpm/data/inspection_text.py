"""An inspection as one screen of text."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence

from nmpm._support.messages import span
from nmpm.data.findings import Finding, Severity, merge_findings
from nmpm.data.inspection import Inspection, Range

_WIDTH = 100
_GRIDS_ASIDE = 2  # of the recommended one, on either side
_MOST_FINDINGS = 7
_NOTE_LINES = 10
_PLAIN_TO_SEE = {"sequence_length", "particle_types", "prescribed_types"}
_TITLES = {"contradiction": "contradictions: models of these data will be wrong", "oddity": "odd: look at it"}


def describe(inspection: Inspection) -> Iterator[str]:
    """Lines: contradictions and oddities first, then splits, facts, grids and notes."""
    merged = merge_findings(inspection.findings, sum(split.inspected for split in inspection.splits.values()))
    yield from _title_lines(inspection, [finding for finding in merged if finding.severity != Severity.NOTE])
    yield from _row_lines(inspection)
    yield from _grid_lines(inspection)
    yield from _note_lines(inspection, [finding for finding in merged if finding.severity == Severity.NOTE])


def _title_lines(inspection: Inspection, findings: Sequence[Finding]) -> Iterator[str]:
    """The dataset, contradictions, oddities, and the splits."""
    timed = not inspection.found.get("dt", "").startswith("guessed")
    times = f"frames {inspection.dt:g} apart in time" if timed else "no times recorded: a frame is the unit of time"
    yield f"{inspection.path}: {inspection.dim}-D, {times}"
    for severity, title in _TITLES.items():
        if some := [finding for finding in findings[:_MOST_FINDINGS] if finding.severity == severity]:
            yield from ("", f"  {title}")
            for finding in some:
                yield from _item(str(finding))
    if more := findings[_MOST_FINDINGS:]:
        yield f"  … and {', '.join(finding.kind for finding in more)}: see --json."
    yield from ("",) if findings else ("  nothing contradictory or odd found", "")
    for name, split in inspection.splits.items():
        trajectories = "trajectory" if split.trajectories == 1 else "trajectories"
        read = "" if split.inspected == split.trajectories else f" ({split.inspected} read)"
        static = f" + {_span(split.static)} at rest" if split.static[1] else ""
        yield (
            f"  {name:<6}{split.trajectories:>5} {trajectories}{read} of {_span(split.frames)} frames,"
            f" {_span(split.particles)} particles{static}"
        )


def _row_lines(inspection: Inspection) -> Iterator[str]:
    """A row for each fact, at most 100 characters wide."""
    bounds = "found" if "bounds" in inspection.found else "stated"
    measured = ", ".join(f"{value:.3g}" for value in inspection.first_acceleration)
    gravity = "not stated" if inspection.gravity is None else ", ".join(f"{value:g}" for value in inspection.gravity)
    gravity = "differs between trajectories" if "gravity" in inspection.varies else gravity
    share, each = 100 * inspection.occupied, 100 * inspection.occupied_each
    rest = "no trajectory comes to rest"
    if inspection.rest is not None:
        middle, first, last = inspection.rest
        moving = f"; {inspection.restless} still move at their end" if inspection.restless else ""
        timed = not inspection.found.get("dt", "").startswith("guessed")
        time = f", time {middle * inspection.dt:.3g}" if timed else ""
        rest = f"from frame {middle} on ({first}-{last}){time}{moving}"
    rows = {
        "materials": ", ".join(f"{name} ({_span(count)})" for name, count in inspection.materials.items()),
        "fields": ", ".join(f"{name} {shape}" for name, shape in inspection.fields.items()),
        "channels": "\n".join(f"{name} {text}" for name, text in inspection.channels.items()),
        "varies": ", ".join(inspection.varies) or "nothing but the initial state",
        "bounds": f"{_box(inspection.stated_bounds)} {bounds}\n{_box(inspection.observed)} observed",
        "domain": f"{_box(inspection.domain)} for a grid; {', '.join(inspection.boundary)}",
        "gravity": f"{gravity}; median acceleration in the first frames: {measured}",
        "occupied": f"{share:.2g}% of the domain, one trajectory {each:.2g}%",
        "at rest": rest,
    }
    for label, text in rows.items():
        for number, line in enumerate(text.splitlines()):
            start = f"  {'' if number else label:<10}"
            yield from textwrap.wrap(line, _WIDTH, initial_indent=start, subsequent_indent=" " * 14)


def _grid_lines(inspection: Inspection) -> Iterator[str]:
    """A table of the grids around the recommended one."""
    yield ""
    yield "  grid          particles per    cells per frame               training here, 15 minutes"
    yield "                occupied cell    median    99.9%      max      s a step     steps"
    first = max(0, [grid.cells for grid in inspection.grids].index(inspection.recommended) - _GRIDS_ASIDE)
    for grid in inspection.grids[first : first + 2 * _GRIDS_ASIDE + 1]:
        cost = inspection.costs[grid.cells]
        mark = "  <- recommended" if grid.cells == inspection.recommended else ""
        mark = mark if cost.fits else f"  needs {cost.memory / 1e9:.0f} GB of memory"
        yield (
            f"  {' x '.join(map(str, grid.shape)):<14}{grid.per_cell:>10.2f}    {grid.median_speed:>9.3f}"
            f"{grid.high_speed:>9.2f}{grid.most_speed:>9.2f}{cost.seconds:>14.2g}{cost.steps:>10}{mark}"
        )


def _note_lines(inspection: Inspection, findings: Sequence[Finding]) -> Iterator[str]:
    """Notes, in which facts that were found in the trajectories are one."""
    levels: dict[str, list[str]] = {"measured": [], "likely": [], "guessed": []}
    for name, how in inspection.found.items():
        if name not in _PLAIN_TO_SEE:
            levels[how.partition(":")[0]].append(name)
    sure = "; ".join(f"{level} {', '.join(names)}" for level, names in levels.items() if names)
    notes = [f"Found in the trajectories: {sure} (--json says how)."] if sure else []
    notes += [note for note in inspection.notes if note.partition(" ")[0] not in inspection.found]
    notes += [str(finding) for finding in findings if finding.sentence not in inspection.notes]
    lines = [line for note in notes for line in _item(note)]
    if lines:
        yield from ("", "  notes", *lines[:_NOTE_LINES])
    if len(lines) > _NOTE_LINES:
        yield "    … more by --json"


def _item(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="  - ", subsequent_indent="    ")


def _span(values: Range) -> str:
    return str(values[0]) if values[0] == values[1] else f"{values[0]}-{values[1]}"


def _box(box: Iterable[tuple[float, float]]) -> str:
    return " x ".join(map(span, box))
