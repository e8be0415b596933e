"""`nmpm inspect PATH`."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.options import CommandParser, add_data_options, check_at_least, check_picture, data_options
from nmpm.errors import ConfigError, DataError, NmpmError

if TYPE_CHECKING:
    from nmpm.data.convert import Options
    from nmpm.data.grid_rule import GridCost
    from nmpm.data.inspection import Inspection, Range
    from nmpm.data.inspection.findings import Finding
    from nmpm.data.loading.sources import FolderSource

_WIDTH = 100
_GRIDS_ASIDE = 2  # of the recommended one, on either side
_MOST_FINDINGS = 7
_NOTE_LINES = 10
_PLAIN_TO_SEE = {"sequence_length", "particle_types", "prescribed_types"}
_TITLES = {"contradiction": "contradictions: models of these data will be wrong", "oddity": "odd: look at it"}
_EXAMPLES = """\
examples:
  nmpm inspect ramps                                   a dataset in the native layout
  nmpm inspect datasets/WaterRamps                     any format that nmpm convert reads
  nmpm inspect waterdrop --family deepmind --gravity 0,-9.81
  nmpm inspect ramps --json | jq .grids
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["inspect", "ramps"]."""
    parser = CommandParser(
        prog="nmpm inspect",
        description="Summarise a dataset on one screen, what contradicts itself first, and draw its first trajectory.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("path", type=Path, help="a dataset, of any format that nmpm convert reads")
    parser.add_argument("--format", metavar="NAME", help="format of the dataset (default: detected)")
    parser.add_argument("--json", action="store_true", help="print everything as JSON, draw nothing")
    parser.add_argument("--trajectories", type=int, metavar="N", help="read N of each split (default: 256 MiB of it)")
    parser.add_argument("--out", type=Path, help="picture to write (default: inspect-NAME.png)")
    parser.add_argument("--no-picture", action="store_true", help="do not draw")
    add_data_options(parser)
    arguments = parser.parse_args(words[1:])
    check_at_least("--trajectories", arguments.trajectories, 1)
    if arguments.out is not None:
        check_picture("--out", arguments.out)
    if not arguments.path.exists():
        raise ConfigError(f"{arguments.path}: there is no such file or folder.")
    options = data_options(arguments)
    with tempfile.TemporaryDirectory() as folder:
        native = Path(folder) / (arguments.path.resolve().stem or "dataset")
        _inspect(*_open(arguments.path, arguments.format, options, native), arguments)


def _inspect(source: FolderSource, damage: list[str], arguments: argparse.Namespace) -> None:
    from nmpm.data.inspection import inspect
    from nmpm.data.inspection.findings import Finding, Severity

    inspection = inspect(source, arguments.trajectories)
    damaged = (Finding("unreadable", Severity.CONTRADICTION, problem) for problem in damage)
    inspection = replace(inspection, path=str(arguments.path), findings=(*damaged, *inspection.findings))
    inspection, costs = _with_costs(inspection)
    if arguments.json:
        plain = asdict(inspection) | {"costs": {cells: asdict(cost) for cells, cost in costs.items()}}
        sys.stdout.write(json.dumps(plain, indent=1) + "\n")
        return
    sys.stdout.write("\n".join(_lines(inspection, costs)) + "\n")
    if arguments.no_picture:
        return
    from nmpm.data.inspection.reading import open_dataset
    from nmpm.viz import write_snapshots
    from nmpm.viz.files import label_trajectory

    path, title = arguments.path.resolve(), f"{arguments.path.name}, first trajectory"
    try:
        data = open_dataset(source)
        trajectory = next(iter(data.splits.values())).read(0)
        pictured = label_trajectory(trajectory, "recorded", data.source.metadata, data.source.scene, title)
        out = write_snapshots(pictured, arguments.out or Path(f"inspect-{path.stem}.png"))
        sys.stdout.write(f"\nwrote {out}\n")
    except (NmpmError, OSError) as error:
        sys.stdout.write(f"\nno picture: {error}\n")


def _with_costs(inspection: Inspection) -> tuple[Inspection, dict[int, GridCost]]:
    """The inspection with the cells that are recommended for this machine, and what a training on each grid costs."""
    from nmpm.data.grid_rule import grid_cost, recommended_cells, training_size
    from nmpm.evaluation.pace import measure_machine

    machine = measure_machine(inspection.dim)
    particles = max(split.particles[1] for split in inspection.splits.values())
    shapes = {grid.cells: grid.shape for grid in inspection.grids}
    costs = {
        cells: grid_cost(shape, particles, machine, training_size(shape, particles, machine))
        for cells, shape in shapes.items()
    }
    return replace(inspection, recommended=recommended_cells(inspection.grids, particles, machine)), costs


def _open(path: Path, format_name: str | None, options: Options, native: Path) -> tuple[FolderSource, list[str]]:
    """The dataset, and problems of its conversion, which is in the cache; in the folder `native` if it is damaged."""
    from nmpm.data.convert import convert, native_folder
    from nmpm.data.format import is_native
    from nmpm.data.loading.sources import FolderSource

    path, problems = _dataset_of(path), list[str]()
    if format_name is None:
        if is_native(path):
            return FolderSource(path, options), []
        try:
            return FolderSource(native_folder(path, options)), []
        except ConfigError as error:  # the gravity contradicts the files
            return FolderSource(native_folder(path, replace(options, gravity=None))), [str(error)]
        except DataError as error:
            problems = [str(error)]
    damage: list[str] = []
    convert(path, native, format_name, options, problems=damage)
    return FolderSource(native), damage or problems


def _dataset_of(path: Path) -> Path:
    """The folder of the dataset that an HDF5 file is a split of; other paths unchanged."""
    from nmpm.data.split_files import split_paths

    return path.parent if path in split_paths(path.parent).values() else path


def _lines(inspection: Inspection, costs: Mapping[int, GridCost]) -> Iterator[str]:
    """The lines of the summary, at most 100 characters wide."""
    yield f"{inspection.path}: {inspection.dim}-D, {_time_step(inspection)}"
    yield from _finding_lines(inspection)
    for name, split in inspection.splits.items():
        trajectories = "trajectory" if split.trajectories == 1 else "trajectories"
        read = "" if split.inspected == split.trajectories else f" ({split.inspected} read)"
        static = f" + {_span(split.static)} at rest" if split.static[1] else ""
        yield (
            f"  {name:<6}{split.trajectories:>5} {trajectories}{read} of {_span(split.frames)} frames,"
            f" {_span(split.particles)} particles{static}"
        )
    rows = {"materials": ", ".join(f"{name} ({_span(count)})" for name, count in inspection.materials.items())}
    rows["fields"] = ", ".join(f"{name} {shape}" for name, shape in inspection.fields.items())
    rows["channels"] = "\n".join(f"{name} {text}" for name, text in inspection.channels.items())
    rows["varies"] = ", ".join(inspection.varies) or "nothing but the initial state"
    bounds = "found" if "bounds" in inspection.found else "stated"
    rows["bounds"] = f"{_box(inspection.stated_bounds)} {bounds}\n{_box(inspection.observed)} observed"
    rows["domain"] = f"{_box(inspection.domain)} for a grid; {', '.join(inspection.boundary)}"
    measured = ", ".join(f"{value:.3g}" for value in inspection.first_acceleration)
    gravity = "not stated" if inspection.gravity is None else ", ".join(f"{value:g}" for value in inspection.gravity)
    gravity = "differs between trajectories" if "gravity" in inspection.varies else gravity
    rows["gravity"] = f"{gravity}; median acceleration in the first frames: {measured}"
    share, each = 100 * inspection.occupied, 100 * inspection.occupied_each
    rows["occupied"] = f"{share:.2g}% of the domain, one trajectory {each:.2g}%"
    rows["at rest"] = "no trajectory comes to rest"
    if inspection.rest is not None:
        middle, first, last = inspection.rest
        moving = f"; {inspection.restless} still move at their end" if inspection.restless else ""
        time = "" if _guessed(inspection, "dt") else f", time {middle * inspection.dt:.3g}"
        rows["at rest"] = f"from frame {middle} on ({first}-{last}){time}{moving}"
    for label, text in rows.items():
        for number, line in enumerate(text.splitlines()):
            start = f"  {'' if number else label:<10}"
            yield from textwrap.wrap(line, _WIDTH, initial_indent=start, subsequent_indent=" " * 14)
    yield from _grid_lines(inspection, costs)
    yield from _note_lines(inspection)


def _time_step(inspection: Inspection) -> str:
    if _guessed(inspection, "dt"):
        return "no times recorded: a frame is the unit of time"
    return f"frames {inspection.dt:g} apart in time"


def _guessed(inspection: Inspection, name: str) -> bool:
    return inspection.found.get(name, "").startswith("guessed")


def _note_lines(inspection: Inspection) -> Iterator[str]:
    """Notes, in which facts that were found in the trajectories are one."""
    levels: dict[str, list[str]] = {"measured": [], "likely": [], "guessed": []}
    for name, how in inspection.found.items():
        if name not in _PLAIN_TO_SEE:
            levels[how.partition(":")[0]].append(name)
    sure = "; ".join(f"{level} {', '.join(names)}" for level, names in levels.items() if names)
    notes = [f"Found in the trajectories: {sure} (--json says how)."] if sure else []
    notes += [note for note in inspection.notes if note.partition(" ")[0] not in inspection.found]
    merged = [note for note in _merged(inspection) if note.severity == "note"]
    notes += [str(note) for note in merged if note.sentence not in inspection.notes]
    lines = [line for note in notes for line in _item(note)]
    if lines:
        yield from ("", "  notes", *lines[:_NOTE_LINES])
    if len(lines) > _NOTE_LINES:
        yield "    … more by --json"


def _grid_lines(inspection: Inspection, costs: Mapping[int, GridCost]) -> Iterator[str]:
    """A table of the grids around the recommended one."""
    yield ""
    yield "  grid          particles per    cells per frame               training here, 15 minutes"
    yield "                occupied cell    median    99.9%      max      s a step     steps"
    first = max(0, [grid.cells for grid in inspection.grids].index(inspection.recommended) - _GRIDS_ASIDE)
    for grid in inspection.grids[first : first + 2 * _GRIDS_ASIDE + 1]:
        cost = costs[grid.cells]
        mark = "  <- recommended" if grid.cells == inspection.recommended else ""
        mark = mark if cost.fits else f"  needs {cost.memory / 1e9:.0f} GB of memory"
        yield (
            f"  {' x '.join(map(str, grid.shape)):<14}{grid.per_cell:>10.2f}    {grid.median_speed:>9.3f}"
            f"{grid.high_speed:>9.2f}{grid.most_speed:>9.2f}{cost.seconds:>14.2g}{cost.steps:>10}{mark}"
        )


def _finding_lines(inspection: Inspection) -> Iterator[str]:
    """Contradictions, then oddities."""
    findings = [finding for finding in _merged(inspection) if finding.severity != "note"]
    for severity, title in _TITLES.items():
        if some := [finding for finding in findings[:_MOST_FINDINGS] if finding.severity == severity]:
            yield from ("", f"  {title}")
            for finding in some:
                yield from _item(str(finding))
    if more := findings[_MOST_FINDINGS:]:
        yield f"  … and {', '.join(finding.kind for finding in more)}: see --json."
    yield from ("",) if findings else ("  nothing contradictory or odd found", "")


def _item(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="  - ", subsequent_indent="    ")


def _merged(inspection: Inspection) -> tuple[Finding, ...]:
    from nmpm.data.inspection.findings import merge_findings

    return merge_findings(inspection.findings, sum(split.inspected for split in inspection.splits.values()))


def _span(values: Range) -> str:
    return str(values[0]) if values[0] == values[1] else f"{values[0]}-{values[1]}"


def _box(box: Iterable[tuple[float, float]]) -> str:
    return " x ".join(f"{low:.4g}…{high:.4g}" for low, high in box)
