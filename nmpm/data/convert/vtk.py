"""VTK's files of points: legacy `.vtk`, XML `.vtp` and `.vtu`, and `.pvd` lists of them with times.

They are read by vtk, which crashes on damaged files: in child processes (`nmpm._support.isolated`). What they declare
is compared with what they hold before.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from nmpm._support.bounded_files import check_regular, check_within, expansion_limit, read_bounded
from nmpm._support.isolated import call_isolated
from nmpm._support.messages import one_line
from nmpm.data.convert.base import needs
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.frames import Frame
from nmpm.errors import DataError

_LIST_BYTES = 2**26
_LISTS = (".pvd", ".series")
_HEADER_BYTES = 2**16
_POINT_BYTES = 6  # "0 0 0 "
_TIMES = ("timevalue", "time")
_KINDS = ("PolyData", "UnstructuredGrid", "PPolyData", "PUnstructuredGrid")
_REFERENCES = ("source", "file", "filename", "href")
_BLOCK_BYTES = 2**20


class Vtk(FrameFormat):
    """A file per frame; or a `.pvd` or ParaView's `.series` that lists the files of a run with their times."""

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
    needs(path, "VTK", "pyvista", "vtk", module="vtkmodules")
    content = call_isolated(read_points, path)
    stated = {} if time is None else {"time": time}
    return Frame(**content | stated | {"left_out": tuple(content["left_out"])})


def _entries(path: Path) -> list[tuple[Path, float]]:
    """The files that a `.pvd` or `.series` lists and their times, ordered by time.

    Raises:
        DataError: if it is not such a list, or names a file twice for a time or outside of its folder.
    """
    content, series = read_bounded(path, _LIST_BYTES), path.suffix.lower() == ".series"
    try:
        if series:
            listed = [(item["name"], item["time"]) for item in json.loads(content)["files"]]
        elif b"<!" in content.replace(b"<!--", b""):
            raise ValueError("a document type is declared")
        else:
            sets = ElementTree.fromstring(content).findall("./Collection/DataSet")  # noqa: S314 (no entities)
            listed = [(item.attrib["file"], item.attrib["timestep"]) for item in sets]
        entries = [(path.parent / str(name), float(time)) for name, time in listed]
    except (ElementTree.ParseError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        needed = "files need name and time" if series else "DataSets need file and timestep"
        raise DataError(f"{path}: cannot be read as a list of VTK files ({one_line(error)}); its {needed}.") from error
    if not entries:
        raise DataError(f"{path}: it lists no file.")
    for file, _ in entries:
        check_within(path, file)
    times = [time for _, time in entries]
    if len(set(times)) < len(times):
        raise DataError(f"{path}: it lists more than one file for a time, e.g. parts of one frame. Merge these first.")
    return sorted(entries, key=lambda entry: entry[1])


def read_points(path: Path) -> dict[str, Any]:
    """The fields of `nmpm.data.convert.frames.Frame` that the file states.

    Raises:
        DataError: if vtk finds an error, the file declares more than it holds, or names files out of its folder.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkCommonDataModel import VTK_POLY_VERTEX, VTK_VERTEX, vtkCellTypes
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLGenericDataObjectReader

    legacy = path.suffix.lower() == ".vtk"
    if legacy:
        with path.open("rb") as file:
            header = file.read(_HEADER_BYTES)
        declared = re.findall(rb"^\s*POINTS\s+(-?\d{1,18})", header, re.MULTILINE | re.IGNORECASE)
        _check_counts(path, list(map(int, declared)), path.stat().st_size // _POINT_BYTES)
        reader = vtkGenericDataObjectReader()
        for switch in ("Scalars", "Vectors", "Normals", "Tensors", "TCoords", "Fields"):
            getattr(reader, f"ReadAll{switch}On")()
    else:
        _check_xml(path)
        reader = vtkXMLGenericDataObjectReader()
    # Messages are the only sign of a file that is cut short.
    window = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(window)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    reader.SetFileName(str(path))
    reader.Update()
    output, problems = reader.GetOutput(), _text(window.GetOutput())
    if output is None or re.search("error", problems, re.IGNORECASE):
        lines = [re.sub(r"^vtk\w+ \(0x\w+\): ", "", line) for line in problems.splitlines()]
        reason = next((line for line in lines if "rror" in line), "it is damaged")
        raise DataError(f"{path}: cannot be read as VTK ({one_line(reason)}). Is it complete?")
    if not output.IsA("vtkPointSet"):
        raise _kind_error(path, output.GetClassName().removeprefix("vtk"))
    points = output.GetPoints()
    position = np.zeros((0, 3)) if points is None else vtk_to_numpy(points.GetData())
    data, cells = output.GetPointData(), output.GetCellData()
    arrays, cell_arrays = _arrays(data, vtk_to_numpy), _arrays(cells, vtk_to_numpy)
    fit = output.GetNumberOfCells() == len(position)  # a vertex for each point
    arrays = cell_arrays | arrays if fit else arrays
    if (ids := data.GetGlobalIds()) is not None:
        arrays["GlobalIds"] = vtk_to_numpy(ids)
    for name, array in arrays.items():
        if len(array) != len(position):
            raise DataError(f"{path}: {one_line(name, 40)} has {len(array)} values for {len(position)} points.")
    left_out = [] if fit else [f"{name} of cells" for name in cell_arrays]
    time = None  # that the field data state
    for index in range(output.GetFieldData().GetNumberOfArrays()):
        array = output.GetFieldData().GetArray(index)
        if array is not None and _text(array.GetName()).lower() in _TIMES and array.GetNumberOfValues() == 1:
            time = float(array.GetTuple1(0))
            break
    kinds = vtkCellTypes()
    output.GetCellTypes(kinds)
    faces = {kinds.GetCellType(index) for index in range(kinds.GetNumberOfTypes())} - {VTK_POLY_VERTEX, VTK_VERTEX}
    return {
        "position": position,
        "arrays": arrays,
        "time": time,
        "left_out": left_out,
        "surface": bool(faces),
    }


def _text(value: str | bytes | None) -> str:
    """A text of vtk, which comes as bytes where it is no UTF-8."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value or ""


def _arrays(data: Any, convert: Any) -> dict[str, np.ndarray]:
    """The arrays of points or cells, by name."""
    arrays: dict[str, np.ndarray] = {}
    for index in range(data.GetNumberOfArrays()):
        array = data.GetAbstractArray(index)
        name = _text(array.GetName()) or f"array{index}"
        if array.IsNumeric():
            arrays[name] = convert(array)
        elif array.IsA("vtkStringArray"):
            arrays[name] = np.array([_text(array.GetValue(i)) for i in range(array.GetNumberOfValues())], dtype=str)
    return arrays


def _kind_error(path: Path, kind: str) -> DataError:
    return DataError(f"{path}: it has a {one_line(kind, 40)}; particles are points.")


def _check_counts(path: Path, counts: list[int], most: int) -> None:
    """Refuses a file that declares more points or cells than fit into it."""
    for count in counts:
        if not 0 <= count <= most:
            size = path.stat().st_size
            raise DataError(f"{path}: it declares {count:,} points or cells but has {size:,} bytes. Is it complete?")


def _check_xml(path: Path, is_part: bool = False) -> None:
    """Refuses an XML file that declares more than fits into it, or names files that are not in its folder.

    Its elements are parsed up to raw data, which end what is XML; parts that it names are checked, too.
    """
    check_regular(path)
    limit, parts = expansion_limit(path.stat().st_size), list[Path]()
    raw, tuples, declared = False, 0, 0

    def doctype(*_: object) -> None:  # its entities would hide what is declared
        raise DataError(f"{path}: cannot be read as VTK (it declares a document type).")

    def start(name: str, attributes: Mapping[str, str]) -> None:
        nonlocal raw, tuples, declared
        if raw:
            return
        kind = attributes.get("type", "nothing")
        if name == "VTKFile" and kind not in _KINDS:
            raise _kind_error(path, kind)
        raw = name == "AppendedData" and attributes.get("encoding", "raw") == "raw"
        parts.extend(path.parent / value for key, value in attributes.items() if key.lower() in _REFERENCES)
        numbers = dict[str, int]()  # those that texts begin with, as vtk reads them
        for key, value in attributes.items():
            if key.startswith("NumberOf"):
                digits = re.match(r"\s*[-+]?\d{1,18}", value)
                numbers[key] = int(digits[0]) if digits else 0
        components = numbers.pop("NumberOfComponents", 1)
        _check_counts(path, [components, *numbers.values()], limit // _POINT_BYTES)
        if name == "Piece":
            tuples = max(numbers.values(), default=0)
        elif name.endswith("Array"):
            bits = re.search(r"\d+$", kind)
            size = int(bits[0]) // 8 if bits else 1
            declared += size * max(components, 1) * max(tuples, *numbers.values(), 0)
            if declared > limit:
                raise DataError(f"{path}: it declares {declared:,} bytes of arrays. Is it complete?")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.StartDoctypeDeclHandler = start, doctype
    with path.open("rb") as file:
        try:
            while not raw and (block := file.read(_BLOCK_BYTES)):
                parser.Parse(block, False)
            if not raw:
                parser.Parse(b"", True)
        except expat.ExpatError as error:
            if not raw:
                raise DataError(f"{path}: cannot be read as VTK ({one_line(error)}). Is it complete?") from error
    for part in parts:
        check_within(path, part)
        if is_part:
            raise DataError(f"{path}: it is a part of another file, and names parts itself.")
        _check_xml(part, is_part=True)
