"""`nmpm inspect PATH`."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.help import HelpFormatter
from nmpm.cli.options import add_data_options, check_at_least, check_picture, data_options
from nmpm.errors import ConfigError, DataError, NmpmError

if TYPE_CHECKING:
    from nmpm.data.convert import Options
    from nmpm.data.inspection import Inspection
    from nmpm.data.inspection.facts import Range
    from nmpm.data.loading.sources import FolderSource

_WIDTH = 100
_EXAMPLES = """\
examples:
  nmpm inspect ramps                                   a dataset in the native layout
  nmpm inspect datasets/WaterRamps                     any format that nmpm convert reads
  nmpm inspect waterdrop --family deepmind --gravity 0,-9.81
  nmpm inspect ramps --json | jq .grids
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["inspect", "ramps"]."""
    parser = argparse.ArgumentParser(
        prog="nmpm inspect",
        description="Summarise a dataset on one screen, list suspicious values, and draw its first trajectory.",
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("path", type=Path, help="a dataset, of any format that nmpm convert reads")
    parser.add_argument("--format", metavar="NAME", help="format of the dataset (default: detected)")
    parser.add_argument("--json", action="store_true", help="print everything as JSON, draw nothing")
    parser.add_argument("--trajectories", type=int, metavar="N", help="read N of each split (default: 256 MiB of it)")
    parser.add_argument("--out", type=Path, help="picture to write (default: inspect-NAME.png)")
    parser.add_argument("--no-picture", action="store_true", help="do not draw")
    add_data_options(parser)
    chosen = parser.parse_args(words[1:])
    check_at_least("--trajectories", chosen.trajectories, 1)
    if chosen.out is not None:
        check_picture("--out", chosen.out)
    if not chosen.path.exists():
        raise ConfigError(f"{chosen.path}: there is no such file or folder.")
    options = data_options(chosen)
    with tempfile.TemporaryDirectory() as folder:
        native = Path(folder) / (chosen.path.resolve().stem or "dataset")
        _inspect(*_origin(chosen.path, chosen.format, options, native), chosen)


def _inspect(origin: FolderSource, damage: list[str], chosen: argparse.Namespace) -> None:
    from nmpm.data.inspection import inspect
    from nmpm.data.inspection.tolerance import with_guessed_family

    inspection = inspect(origin, chosen.trajectories)
    inspection = replace(inspection, path=str(chosen.path), findings=(*damage, *inspection.findings))
    if chosen.json:
        sys.stdout.write(json.dumps(inspection.to_dict(), indent=1) + "\n")
        return
    sys.stdout.write("\n".join(lines(inspection)) + "\n")
    if chosen.no_picture:
        return
    try:
        _draw(with_guessed_family(origin), inspection, chosen.out or Path(f"inspect-{chosen.path.resolve().stem}.png"))
    except (NmpmError, OSError) as error:
        sys.stdout.write(f"\nno picture: {error}\n")


def _origin(path: Path, format_name: str | None, options: Options, native: Path) -> tuple[FolderSource, list[str]]:
    """The dataset, converted where it is foreign, and what could not be converted.

    Args:
        path: Of the dataset.
        format_name: Its format; detected when left out.
        options: What the user states.
        native: A folder for conversions that are not kept.
    """
    from nmpm.data.convert import convert
    from nmpm.data.format import split_paths
    from nmpm.data.inspection.tolerance import convert_readable
    from nmpm.data.loading.sources import FolderSource

    path = _dataset_of(path)
    changed = options.types or options.static is not None or options.dt is not None
    if split_paths(path) and not changed and format_name is None:
        return _native_origin(path, options), []
    try:
        if format_name is None:
            return _converted(path, options)
        convert(path, native, format_name, options)
        return FolderSource(native), []
    except DataError as error:
        return FolderSource(native), convert_readable(path, native, format_name, options) or [str(error)]


def _dataset_of(path: Path) -> Path:
    """The folder of the dataset that an HDF5 file is a part of; other paths as they are.

    Raises:
        DataError: if the file cannot be read, or is not a part of a dataset, as a rollout.
    """
    if path.suffix != ".h5" or not path.is_file():
        return path
    from nmpm.data.convert import FORMATS
    from nmpm.data.format import Split, split_paths

    splits = [split.name for split in split_paths(path.parent).values()]
    if path.name in splits or (not splits and any(kind.recognises(path.parent) for kind in FORMATS)):
        return path.parent
    Split(path)
    raise DataError(
        f"{path}: it is not a split of a dataset, which are train.h5, valid.h5 and test.h5 beside a metadata.json. To"
        f" look at its trajectories: nmpm view {path}, or nmpm render {path}."
    )


def _converted(path: Path, options: Options) -> tuple[FolderSource, list[str]]:
    """A foreign dataset in the cache; a gravity that contradicts its files is left out and becomes a finding."""
    from nmpm.data.convert.cache import native_folder
    from nmpm.data.loading.sources import FolderSource

    try:
        return FolderSource(native_folder(path, options)), []
    except ConfigError as error:
        return FolderSource(native_folder(path, replace(options, gravity=None))), [str(error)]


def _native_origin(path: Path, options: Options) -> FolderSource:
    from nmpm.data.loading.sources import FolderSource, StatedFacts

    boundary = options.periodic and ["periodic" if flag else "wall" for flag in options.periodic]
    facts = StatedFacts(options.family, options.gravity, boundary, options.bounds, options.fields)  # type: ignore[arg-type]  # (argparse gives plain lists)
    return FolderSource(path, facts)


def lines(found: Inspection) -> Iterator[str]:
    """The lines of the summary, at most 100 characters wide."""
    yield f"{found.path}: {found.dim}-D, {found.dt:g} s between frames"
    for name, split in found.splits.items():
        trajectories = "trajectory" if split.trajectories == 1 else "trajectories"
        read = "" if split.inspected == split.trajectories else f" ({split.inspected} read)"
        static = f" + {_span(split.static)} at rest" if split.static[1] else ""
        yield (
            f"  {name:<6}{split.trajectories:>5} {trajectories}{read} of {_span(split.frames)} frames,"
            f" {_span(split.particles)} particles{static}"
        )
    yield _format_label("materials", ", ".join(f"{name} ({_span(n)})" for name, n in found.materials.items()))
    if found.fields:
        yield _format_label("fields", ", ".join(f"{name} {shape}" for name, shape in found.fields.items()))
    for index, (name, text) in enumerate(found.channels.items()):
        yield from _format_long("" if index else "channels", f"{name} {text}")
    yield _format_label("varies", ", ".join(found.varies) or "nothing but the initial state")
    yield _format_label("bounds", _box(found.stated_bounds) + " stated")
    yield _format_label("", _box(found.observed) + " observed")
    yield _format_label("domain", f"{_box(found.domain)} for a grid; {', '.join(found.boundary)}")
    yield _format_label("gravity", _gravity(found))
    yield _format_label(
        "occupied", f"{100 * found.occupied:.2g}% of the domain, one trajectory {100 * found.occupied_each:.2g}%"
    )
    yield _format_label("at rest", _rest(found))
    yield ""
    yield "  grid          particles per    cells per frame"
    yield "                occupied cell    median    99.9%      max"
    for grid in found.grids:
        mark = "  <- recommended" if grid.cells == found.recommended else ""
        shape = " x ".join(map(str, grid.shape))
        yield (
            f"  {shape:<14}{grid.per_cell:>10.2f}    {grid.median_speed:>9.3f}{grid.high_speed:>9.2f}"
            f"{grid.most_speed:>9.2f}{mark}"
        )
    for title, items in (("notes", found.notes), ("suspicious", found.findings or ("nothing found",))):
        yield from _format_list(title, items)


def _format_label(label: str, text: str) -> str:
    return f"  {label:<10}{text}"


def _format_long(label: str, text: str) -> Iterator[str]:
    """A label and its text, on further lines where it is long."""
    yield from textwrap.wrap(text, _WIDTH, initial_indent=_format_label(label, ""), subsequent_indent=" " * 14)


def _span(values: Range) -> str:
    return str(values[0]) if values[0] == values[1] else f"{values[0]}-{values[1]}"


def _box(box: Iterable[tuple[float, float]]) -> str:
    return " x ".join(f"{low:.4g}…{high:.4g}" for low, high in box)


def _gravity(found: Inspection) -> str:
    measured = ", ".join(f"{value:.3g}" for value in found.first_acceleration)
    if "gravity" in found.varies:
        stated = "differs between trajectories"
    else:
        stated = "not stated" if found.gravity is None else ", ".join(f"{value:g}" for value in found.gravity)
    return f"{stated}; median acceleration in the first frames: {measured}"


def _rest(found: Inspection) -> str:
    if found.rest is None:
        return "no trajectory comes to rest"
    middle, first, last = found.rest
    moving = f"; {found.restless} still move at their end" if found.restless else ""
    return f"from frame {middle} on ({first}-{last}), {middle * found.dt:.3g} s{moving}"


def _format_list(title: str, items: Iterable[str]) -> Iterator[str]:
    items = list(items)
    if items:
        yield ""
        yield f"  {title}"
    for item in items:
        yield from textwrap.wrap(item, _WIDTH, initial_indent="  - ", subsequent_indent="    ")


def _draw(origin: FolderSource, found: Inspection, path: Path) -> None:
    import numpy as np

    from nmpm.data.format import Split, split_paths
    from nmpm.data.gravity import own_gravity
    from nmpm.viz import LabelledTrajectories, material_names, write_snapshots

    metadata = origin.metadata
    trajectory = Split(next(iter(split_paths(origin.folder).values()))).read(0)
    moving = np.isin(trajectory.particle_type, metadata.moving_types)
    static = np.isin(trajectory.particle_type, list(metadata.static_types))
    pictured = LabelledTrajectories(
        positions={"recorded": trajectory.position[:, moving]},
        material=material_names(trajectory.particle_type[moving], metadata.particle_types),
        bounds=origin.scene.bounds,
        dt=metadata.dt,
        domain=origin.scene.domain,
        obstacle=trajectory.position[0, static],
        periodic=origin.scene.periodic,
        gravity=own_gravity(trajectory.attributes, origin.scene, found.path),
        title=f"{Path(found.path).name}, first trajectory",
    )
    write_snapshots(pictured, path)
    sys.stdout.write(f"\nwrote {path}\n")
