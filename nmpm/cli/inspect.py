"""`nmpm inspect PATH`."""

from __future__ import annotations

import json
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.command import option
from nmpm.cli.options import Existing, FactOptions, Picture, Positive
from nmpm.errors import ConfigError, DataError, NmpmError

if TYPE_CHECKING:
    from nmpm.data.findings import Finding
    from nmpm.data.inspection import Inspection, Range
    from nmpm.data.sources import FolderSource

_WIDTH = 100
_GRIDS_ASIDE = 2  # of the recommended one, on either side
_MOST_FINDINGS = 7
_NOTE_LINES = 10
_PLAIN_TO_SEE = {"sequence_length", "particle_types", "prescribed_types"}
_TITLES = {"contradiction": "contradictions: models of these data will be wrong", "oddity": "odd: look at it"}


@dataclass(frozen=True, kw_only=True)
class Inspect(FactOptions):
    """Summarise a dataset on one screen, with anything odd about it.

    What contradicts itself comes first; the first trajectory is drawn.

    Args:
        path: A dataset, of any format that nmpm convert reads.
        format: Format of the dataset (default: detected).
        json: Print everything as JSON, draw nothing.
        trajectories: Read N of each split (default: 256 MiB of it).
        out: Picture to write (default: inspect-NAME.png).
        no_picture: Do not draw.

    Examples:
        nmpm inspect ramps                                   a dataset in the native layout
        nmpm inspect datasets/WaterRamps                     any format that nmpm convert reads
        nmpm inspect waterdrop --family deepmind --gravity 0,-9.81
        nmpm inspect ramps --json | jq .grids
    """

    path: Existing
    format: str | None = option(metavar="NAME")
    json: bool = False
    trajectories: Positive | None = option(metavar="N")
    out: Picture | None = None
    no_picture: bool = False

    def run(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            native = Path(folder) / (self.path.resolve().stem or "dataset")
            self._inspect(*self._open(native))

    def _open(self, native: Path) -> tuple[FolderSource, list[str]]:
        """The dataset, and problems of its conversion, which is in `native` if the dataset is damaged."""
        from nmpm.data.convert import convert, native_folder
        from nmpm.data.format import is_native, split_paths
        from nmpm.data.sources import FolderSource

        beside = split_paths(self.path.parent).values()
        path, problems = self.path.parent if self.path in beside else self.path, list[str]()
        if self.format is None:
            if is_native(path):
                return FolderSource(path, self.facts), []
            try:
                return FolderSource(native_folder(path, self.facts)), []  # the copy has the facts
            except ConfigError as error:  # the gravity contradicts the files
                return FolderSource(native_folder(path, replace(self.facts, gravity=None))), [str(error)]
            except DataError as error:
                problems = [str(error)]
        damage: list[str] = []
        convert(path, native, self.format, self.facts, problems=damage)
        return FolderSource(native), damage or problems

    def _inspect(self, source: FolderSource, damage: list[str]) -> None:
        from nmpm.data.findings import Finding, Severity, merge_findings
        from nmpm.data.inspection import inspect, open_dataset
        from nmpm.evaluation.pace import measure_machine

        inspection = inspect(source, self.trajectories, measure_machine)
        damaged = (Finding("unreadable", Severity.CONTRADICTION, problem) for problem in damage)
        inspection = replace(inspection, path=str(self.path), findings=(*damaged, *inspection.findings))
        if self.json:
            sys.stdout.write(json.dumps(asdict(inspection), indent=1) + "\n")
            return
        merged = merge_findings(inspection.findings, sum(split.inspected for split in inspection.splits.values()))
        lines = [
            *_title_lines(inspection, [finding for finding in merged if finding.severity != Severity.NOTE]),
            *_row_lines(inspection),
            *_grid_lines(inspection),
            *_note_lines(inspection, [finding for finding in merged if finding.severity == Severity.NOTE]),
        ]
        sys.stdout.write("".join(f"{line}\n" for line in lines))
        if self.no_picture:
            return
        from nmpm.viz import write_snapshots
        from nmpm.viz.files import label_trajectory

        path, title = self.path.resolve(), f"{self.path.name}, first trajectory"
        try:
            data = open_dataset(source)
            trajectory = next(iter(data.splits.values())).read(0)
            pictured = label_trajectory(trajectory, "recorded", data.source.metadata, data.source.scene, title)
            out = write_snapshots(pictured, self.out or Path(f"inspect-{path.stem}.png"))
            sys.stdout.write(f"\nwrote {out}\n")
        except (NmpmError, OSError) as error:
            sys.stdout.write(f"\nno picture: {error}\n")


def _title_lines(inspection: Inspection, findings: Sequence[Finding]) -> Iterator[str]:
    """The dataset, contradictions, oddities, and the splits."""
    times = f"frames {inspection.dt:g} apart in time"
    if _has_no_times(inspection):
        times = "no times recorded: a frame is the unit of time"
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
        time = "" if _has_no_times(inspection) else f", time {middle * inspection.dt:.3g}"
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


def _has_no_times(inspection: Inspection) -> bool:
    return inspection.found.get("dt", "").startswith("guessed")


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
    return " x ".join(f"{low:.4g}…{high:.4g}" for low, high in box)
