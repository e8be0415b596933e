"""VTK's files of points: legacy `.vtk`, XML `.vtp` and `.vtu`, and `.pvd` lists of them with times; read by vtk."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

from nmpm._support.bounded_files import check_regular, check_within, read_bounded
from nmpm._support.isolated import call_isolated
from nmpm._support.messages import install, one_line
from nmpm.data.convert.frame import Frame
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.vtk_points import read_points
from nmpm.errors import ConfigError, DataError

_LIST_BYTES = 2**26
_LISTS = (".pvd", ".series")


class Vtk(FrameFormat):
    """A file per frame; or a `.pvd` or ParaView's `.series` that lists the files of a run with their times."""

    name: ClassVar[str] = "vtk"
    summary: ClassVar[str] = "VTK's .vtk, .vtp, .vtu, a file per frame, or .pvd, .series (extra vtk)"
    patterns: tuple[str, ...] = ("*.pvd", "*.series", "*.vtp", "*.vtu", "*.vtk")
    listings: ClassVar[tuple[str, ...]] = ("*.pvd", "*.series")

    def frames(self, file: Path) -> Iterator[Frame]:
        if file.suffix.lower() not in _LISTS:
            yield _read(file, None)
            return
        entries = _entries(file)
        for number, (path, time) in enumerate(entries):
            try:
                yield _read(path, time)
            except DataError as error:
                hint = " It is the last of the list: if it is still being written, leave it out."
                raise DataError(f"{error}{hint if number == len(entries) - 1 else ''}") from error

    def count(self, file: Path) -> int:
        return len(_entries(file)) if file.suffix.lower() in _LISTS else 1


def _read(path: Path, time: float | None) -> Frame:
    """The points of a file; `time` overrides that in the file."""
    check_regular(path)
    if find_spec("vtkmodules") is None or find_spec("vtkmodules.vtkIOXML") is None:
        raise ConfigError(f"{path}: reading VTK needs pyvista: {install('vtk')}.")
    content = call_isolated(read_points, path)
    content["left_out"] = tuple(content["left_out"])
    return Frame(**content if time is None else content | {"time": time})


def _entries(path: Path) -> list[tuple[Path, float]]:
    """The files that a `.pvd` or `.series` lists and their times, ordered by time.

    Raises:
        DataError: if it is not such a list, or names a file twice for a time or outside of its folder.
    """
    content = read_bounded(path, _LIST_BYTES)
    try:
        listed = _series(content) if path.suffix.lower() == ".series" else _collection(content)
        entries = [(path.parent / name, time) for name, time in listed]
    except (ElementTree.ParseError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        needed = "files need name and time" if path.suffix.lower() == ".series" else "DataSets need file and timestep"
        raise DataError(f"{path}: cannot be read as a list of VTK files ({one_line(error)}); its {needed}.") from error
    if not entries:
        raise DataError(f"{path}: it lists no file.")
    for file, _ in entries:
        check_within(path, file)
    times = [time for _, time in entries]
    if len(set(times)) < len(times):
        raise DataError(f"{path}: it lists more than one file for a time, e.g. parts of one frame. Merge these first.")
    return sorted(entries, key=lambda entry: entry[1])


def _collection(content: bytes) -> list[tuple[str, float]]:
    """The names and times of a `.pvd`."""
    if b"<!" in content.replace(b"<!--", b""):
        raise ValueError("a document type is declared")
    sets = ElementTree.fromstring(content).findall("./Collection/DataSet")  # noqa: S314 (no entities)
    return [(item.attrib["file"], float(item.attrib["timestep"])) for item in sets]


def _series(content: bytes) -> list[tuple[str, float]]:
    """The names and times of a `.series`, which is JSON."""
    return [(str(item["name"]), float(item["time"])) for item in json.loads(content)["files"]]
