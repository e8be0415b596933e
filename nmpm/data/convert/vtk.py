"""VTK's files of points: legacy `.vtk`, XML `.vtp` and `.vtu`, and `.pvd` lists of them with times; read by vtk."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

import numpy as np

from nmpm._support.bounded_files import check_regular, expansion_limit, read_bounded
from nmpm._support.messages import install, one_line
from nmpm.data.convert.frame import Frame
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.errors import ConfigError, DataError

_LIST_BYTES = 2**26
_HEADER_BYTES = 2**16
_POINT_BYTES = 6  # "0 0 0 "
_TIMES = ("timevalue", "time")


class Vtk(FrameFormat):
    """A file per frame; or a `.pvd` that lists the files of a run."""

    name: ClassVar[str] = "vtk"
    summary: ClassVar[str] = f"VTK's .vtk, .vtp, .vtu, a file per frame, or .pvd (needs: {install('vtk')})"
    patterns: tuple[str, ...] = ("*.pvd", "*.vtp", "*.vtu", "*.vtk")
    listing: ClassVar[str] = "*.pvd"

    def frames(self, file: Path) -> Iterator[Frame]:
        if file.suffix.lower() != ".pvd":
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
        return len(_entries(file)) if file.suffix.lower() == ".pvd" else 1


def _read(path: Path, time: float | None) -> Frame:
    """The points of a file; `time` overrides that in the file."""
    check_regular(path)
    try:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
        from vtkmodules.vtkIOXML import vtkXMLGenericDataObjectReader
    except ImportError as error:
        raise ConfigError(f"{path}: reading VTK needs pyvista: {install('vtk')}.") from error
    legacy = path.suffix.lower() == ".vtk"
    _check_size(path)
    reader = vtkGenericDataObjectReader() if legacy else vtkXMLGenericDataObjectReader()
    if legacy:
        for switch in ("Scalars", "Vectors", "Normals", "Tensors", "TCoords", "Fields"):
            getattr(reader, f"ReadAll{switch}On")()
    reader.SetFileName(str(path))
    with _messages() as window:
        reader.Update()
        output, problems = reader.GetOutput(), window.GetOutput()
    # What is no UTF-8 comes as bytes.
    problems = problems.decode("utf-8", "replace") if isinstance(problems, bytes) else problems
    if output is None or re.search("error", problems, re.IGNORECASE):
        lines = [re.sub(r"^vtk\w+ \(0x\w+\): ", "", line) for line in problems.splitlines()]
        reason = next((line for line in lines if "rror" in line), "it is damaged")
        raise DataError(f"{path}: cannot be read as VTK ({one_line(reason)}). Is it complete?")
    if not output.IsA("vtkPointSet"):
        raise DataError(f"{path}: it has a {output.GetClassName().removeprefix('vtk')}; particles are points.")
    points = output.GetPoints()
    position = np.zeros((0, 3)) if points is None else vtk_to_numpy(points.GetData()).copy()
    data, cells = output.GetPointData(), output.GetCellData()
    arrays = _arrays(data, vtk_to_numpy)
    cell_arrays = _arrays(cells, vtk_to_numpy)
    fit = output.GetNumberOfCells() == len(position)  # a vertex for each point
    arrays = cell_arrays | arrays if fit else arrays
    if (ids := data.GetGlobalIds()) is not None:
        arrays["GlobalIds"] = vtk_to_numpy(ids).copy()
    left_out = () if fit else tuple(f"{name} of cells" for name in cell_arrays)
    time = _time(output) if time is None else time
    return Frame(position, arrays, time, left_out=left_out, surface=_has_faces(output))


def _has_faces(output: Any) -> bool:
    """Whether there are cells other than single points and sets of points."""
    from vtkmodules.vtkCommonDataModel import VTK_POLY_VERTEX, VTK_VERTEX, vtkCellTypes

    kinds = vtkCellTypes()
    output.GetCellTypes(kinds)
    return any(
        kinds.GetCellType(index) not in (VTK_VERTEX, VTK_POLY_VERTEX) for index in range(kinds.GetNumberOfTypes())
    )


def _arrays(data: Any, convert: Any) -> dict[str, np.ndarray]:
    """Copies of the arrays of points or cells, by name."""
    arrays: dict[str, np.ndarray] = {}
    for index in range(data.GetNumberOfArrays()):
        array = data.GetAbstractArray(index)
        name = array.GetName() or f"array{index}"
        if array.IsNumeric():
            arrays[name] = convert(array).copy()
        elif array.IsA("vtkStringArray"):
            arrays[name] = np.array([array.GetValue(i) for i in range(array.GetNumberOfValues())], dtype=str)
    return arrays


def _time(output: Any) -> float | None:
    """The time that the field data state."""
    data = output.GetFieldData()
    for index in range(data.GetNumberOfArrays()):
        array = data.GetArray(index)
        if array is not None and (array.GetName() or "").lower() in _TIMES and array.GetNumberOfValues() == 1:
            return float(array.GetTuple1(0))
    return None


@contextmanager
def _messages() -> Iterator[Any]:
    """Collects VTK's messages, which else go to the terminal: the only sign of a file that is cut short."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow

    window, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkOutputWindow.SetInstance(window)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        yield window
    finally:
        vtkOutputWindow.SetInstance(before)
        vtkLogger.SetStderrVerbosity(verbosity)


def _check_size(path: Path) -> None:
    """Refuses a file that declares more points or cells than fit into it: for lack of memory vtk ends the process."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    if path.suffix.lower() == ".vtk":
        most, declared = size // _POINT_BYTES, re.findall(rb"^POINTS\s+(\d{1,18})", start, re.MULTILINE)
    else:
        most, declared = expansion_limit(size) // _POINT_BYTES, re.findall(rb'NumberOf\w+="\s*(-?\d{1,18})', start)
    counts = [int(number) for number in declared]
    if counts and not 0 <= min(counts) <= max(counts) <= most:
        wrong = min(counts) if min(counts) < 0 else max(counts)
        raise DataError(f"{path}: it declares {wrong:,} points or cells but has {size:,} bytes. Is it complete?")


def _entries(path: Path) -> list[tuple[Path, float]]:
    """The files that a `.pvd` lists and their times, ordered by time.

    Raises:
        DataError: if it is not such a list, or names a file twice for a time or outside of its folder.
    """
    content = read_bounded(path, _LIST_BYTES)
    try:
        if b"<!" in content.replace(b"<!--", b""):
            raise ValueError("a document type is declared")
        sets = ElementTree.fromstring(content).findall("./Collection/DataSet")  # noqa: S314 (no entities)
        entries = [(path.parent / item.attrib["file"], float(item.attrib["timestep"])) for item in sets]
    except (ElementTree.ParseError, ValueError, KeyError) as error:
        raise DataError(
            f"{path}: cannot be read as a list of VTK files ({one_line(error)}); its DataSets need file and timestep."
        ) from error
    if not entries:
        raise DataError(f"{path}: it lists no file.")
    outside = [file for file, _ in entries if not file.resolve().is_relative_to(path.parent.resolve())]
    if outside:
        raise DataError(f"{path}: it lists {outside[0]}, which is not in its folder.")
    times = [time for _, time in entries]
    if len(set(times)) < len(times):
        raise DataError(f"{path}: it lists more than one file for a time, e.g. parts of one frame. Merge these first.")
    return sorted(entries, key=lambda entry: entry[1])
