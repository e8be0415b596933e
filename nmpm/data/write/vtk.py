"""VTK's forms: native HDF5 with a group `VTKHDF` beside the trajectories, and XML poly data with a file per frame.

VTK's format (https://docs.vtk.org, "VTKHDF file format") keeps the points of all time steps in one array (T·N, 3), as
the native layout does but for its shape and the third axis of 2-D data. So the points, and the numbers of each point,
are virtual datasets, which refer to the native ones and take no room; where those have two axes, z is the fill value 0.
LagrangeBench takes each group of a file for a trajectory, so that the files of a dataset's splits are left without.
"""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from nmpm._support.atomic import atomic_folder, atomic_write, file_obstacle
from nmpm.data.format import TRUTH, VTKHDF, Trajectory, add_trajectories
from nmpm.data.hdf5 import writable_hdf5
from nmpm.data.predictions import description
from nmpm.data.write.base import Clip, ClipFrame, TrajectoryWriter

MOST_TRAJECTORIES = 32
"""Of a file, which VTK would show; each is a block that it reads in every time step."""
_POLY_DATA_VERSION, _COLLECTION_VERSION = (2, 0), (2, 1)
_CELLS = ("Vertices", "Lines", "Polygons", "Strips")
_COMPRESSED = {"compression": "gzip", "shuffle": True}
_LEAST_BYTES = 2**11  # of what is compressed, as the index of chunks takes as much


@dataclass(frozen=True)
class _Block:
    """Points that VTK shows as one object: the dataset of their positions, in a trajectory's group."""

    name: str
    trajectory: Any
    position: str = "position"

    @property
    def frames(self) -> int:
        return int(self.trajectory[self.position].shape[0])


def write_viewable(path: Path, trajectories: Iterable[Trajectory]) -> None:
    """As `nmpm.data.format.write_split`, with what VTK needs to show them."""
    # The earliest format that has virtual datasets.
    with writable_hdf5(path, libver=("earliest", "v110")) as (file, check_written):
        add_trajectories(file, trajectories, check_written, path)
        add_vtkhdf(file)


def add_vtkhdf(file: Any) -> None:
    """Adds what VTK needs to show the trajectories of an open HDF5 file, the first `MOST_TRAJECTORIES` of them.

    One trajectory alone becomes VTK's poly data; several, or one with its truth, become a data set with a block for
    each. A block that is shorter than others stays at its last frame. Times are the longest trajectory's.
    """
    blocks = list(_blocks([file[name] for name in list(file)[:MOST_TRAJECTORIES]]))
    longest = max(blocks, key=lambda block: block.frames)
    times = _times(longest.trajectory, longest.frames)
    root = _ordered_group(file, VTKHDF)
    if len(blocks) == 1:
        _set_type(root, "PolyData", _POLY_DATA_VERSION)
        _write_block(root, blocks[0], times)
        return
    _set_type(root, "MultiBlockDataSet", _COLLECTION_VERSION)
    assembly = _ordered_group(root, "Assembly")
    for block in blocks:
        group = root.create_group(block.name)
        _set_type(group, "PolyData", _COLLECTION_VERSION)
        assembly[block.name] = h5py.SoftLink(group.name)
        _write_block(group, block, times)


def _times(trajectory: Any, frames: int) -> np.ndarray:
    """(T,) recorded times, or else those of frames that are `dt` of the described scene apart, or 1 without one."""
    stated = trajectory.get("time")
    if isinstance(stated, h5py.Dataset) and stated.shape == (frames,):
        return np.asarray(stated[()], dtype=np.float64)
    scene = trajectory.attrs.get("scene")
    return np.arange(frames) * float(1.0 if scene is None else json.loads(scene)["dt"])


def _blocks(trajectories: list[Any]) -> Iterator[_Block]:
    for trajectory in trajectories:
        number = "" if len(trajectories) == 1 else "_" + trajectory.name.strip("/")
        truth, shape = trajectory.get(TRUTH), trajectory["position"].shape
        has_truth = (
            isinstance(truth, h5py.Dataset) and truth.ndim == 3 and truth.shape[1:] == shape[1:] and truth.shape[0] > 0
        )
        yield _Block(("prediction" if has_truth else "trajectory") + number, trajectory)
        if has_truth:
            yield _Block(TRUTH + number, trajectory, TRUTH)


def _ordered_group(parent: Any, name: str) -> Any:
    """A group that keeps the order of its members, as VTK needs of collections, without a time stamp."""
    properties = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    properties.set_link_creation_order(h5py.h5p.CRT_ORDER_TRACKED | h5py.h5p.CRT_ORDER_INDEXED)
    properties.set_obj_track_times(False)
    h5py.h5g.create(parent.id, name.encode(), gcpl=properties)
    return parent[name]


def _set_type(group: Any, name: str, version: tuple[int, int]) -> None:
    group.attrs["Version"] = np.array(version, dtype=np.int64)
    group.attrs.create("Type", name.encode(), dtype=h5py.string_dtype("ascii", len(name)))


def _write_block(group: Any, block: _Block, times: np.ndarray) -> None:
    position = block.trajectory[block.position]
    frames, particles, dim = position.shape
    steps = group.create_group("Steps")
    steps.attrs["NSteps"] = len(times)
    frame = np.minimum(np.arange(len(times)), frames - 1)
    _write(steps, "Values", times)
    _write(steps, "PartOffsets", frame)
    _write(steps, "NumberOfParts", np.ones(len(times)))
    _write(steps, "PointOffsets", frame * particles)
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        _write(steps, name, np.zeros((len(times), len(_CELLS))))
    _write(group, "NumberOfPoints", np.full(frames, particles))
    for name in _CELLS:  # a vertex for each point, the same in every frame
        cells, count = group.create_group(name), particles if name == "Vertices" else 0
        _write(cells, "Connectivity", np.arange(count))
        _write(cells, "Offsets", np.arange(count + 1))
        for total in ("NumberOfCells", "NumberOfConnectivityIds"):
            _write(cells, total, np.full(frames, count))
    _map(group, "Points", position, 2, dim)
    data, offsets = group.create_group("PointData"), steps.create_group("PointDataOffsets")
    for name, values in block.trajectory.items():
        is_field = isinstance(values, h5py.Dataset) and name not in ("position", TRUTH, "time")
        if not is_field or values.dtype.kind not in "iuf" or values.dtype.itemsize == 2 or not 1 <= values.ndim <= 3:
            continue
        by_point = values.shape[0] == particles and values.ndim < 3
        leading = 2 if values.shape[:2] == (frames, particles) else int(by_point)  # axes (T, N, …), (N, …), or others
        if leading == 1 or (leading == 2 and block.position != TRUTH):  # other fields are those of the prediction
            _map(data, name, values, leading, dim)
            _write(offsets, name, frame * particles if leading == 2 else np.zeros(len(times)))


def _write(group: Any, name: str, values: np.ndarray) -> None:
    """Numbers of VTK's bookkeeping: integers, but for times."""
    values = values if name == "Values" else values.astype(np.int64)
    group.create_dataset(name, data=values, **(_COMPRESSED if values.nbytes > _LEAST_BYTES else {}))


def _map(group: Any, name: str, values: Any, leading: int, dim: int) -> None:
    """A virtual dataset with a row for each point in each frame, the `leading` axes of the values; vectors have z."""
    rows, rest = math.prod(values.shape[:leading]), values.shape[leading:]
    space = h5py.h5s.create_simple((rows, *((3,) if rest == (dim,) else rest)))
    space.select_hyperslab((0,) * space.get_simple_extent_ndims(), (rows, *rest))
    # By hand: h5py's `create_virtual_dataset` writes time stamps.
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.VIRTUAL)
    properties.set_virtual(space, b".", values.name.encode(), h5py.h5s.create_simple(values.shape))
    properties.set_fill_value(np.zeros(1, values.dtype))
    properties.set_obj_track_times(False)
    space.select_all()
    h5py.h5d.create(group.id, name.encode(), values.id.get_type(), space, properties)


class NativeHdf5(TrajectoryWriter):
    """The native layout: a file that all of nmpm reads, and ParaView."""

    readers: ClassVar[str] = "nmpm view, ParaView"

    def write(self, path: Path, clip: Clip) -> Path:
        return self.write_all(path, [clip])[0]

    def write_all(self, path: Path, clips: Iterable[Clip]) -> list[Path]:
        def described() -> Iterator[Trajectory]:
            for clip in clips:
                trajectory, metadata = clip.trajectory, clip.metadata
                scene = description(trajectory, metadata, clip.spacing**metadata.dim)
                yield replace(trajectory, attributes=scene | trajectory.attributes, fields=self.fields(clip))
                clip.step_all()

        write_viewable(path, described())
        return [path]

    def paths(self, path: Path, count: int) -> list[Path]:  # noqa: ARG002
        return [path]

    def left_out(self, trajectory: Trajectory) -> set[str]:  # noqa: ARG002
        return set()

    def fields(self, clip: Clip) -> dict[str, np.ndarray]:
        """The fields to write."""
        return clip.trajectory.fields

    def hint(self, path: Path) -> str:
        return f"nmpm view {shlex.quote(str(path))}, or ParaView"


class NativeVtkHdf(NativeHdf5):
    """The same, by the suffix that ParaView knows, with velocities."""

    readers: ClassVar[str] = "ParaView, nmpm view"

    def fields(self, clip: Clip) -> dict[str, np.ndarray]:
        return {"velocity": np.stack(list(clip.velocities())), **clip.trajectory.fields}


_HEAD = '<VTKFile type="{}" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
_VTK_TYPES = {"f4": "Float32", "f8": "Float64", "i8": "Int64"}


class VtpSeries(TrajectoryWriter):
    """`out.pvd` and beside it the folder `out` of a .vtp per frame."""

    readers: ClassVar[str] = "ParaView, VisIt, PyVista"

    def write(self, path: Path, clip: Clip) -> Path:
        folder, collection, lines = path.with_suffix(""), path.with_suffix(".pvd"), list[str]()
        with atomic_folder(folder) as new:
            for frame in clip.frames():
                name = f"{frame.number:06d}.vtp"
                (new / name).write_bytes(vtp(frame))
                lines.append(f'<DataSet timestep="{frame.time!r}" file="{escape(folder.name)}/{name}"/>\n')
        with atomic_write(collection) as part:
            text = f"{_HEAD.format('Collection')}<Collection>\n{''.join(lines)}</Collection>\n</VTKFile>\n"
            part.write_text(text, encoding="utf-8")
        return collection

    def obstacle(self, path: Path) -> str:
        folder, collection = path.with_suffix(""), path.with_suffix(".pvd")
        names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
        is_series = collection.is_file() and all(re.fullmatch(r"\d{6,}\.vtp", name) for name in names)
        if folder.is_file() or (names and not is_series):
            return f"its frames would replace {folder}, which is not such a series; choose another name."
        return file_obstacle(collection)


def vtp(frame: ClipFrame) -> bytes:
    """A frame as VTK's XML, with the numbers behind it as they are."""
    count, blocks = len(frame.index), list[bytes]()

    def array(name: str, values: np.ndarray) -> str:
        kind = "f8" if values.dtype == np.float64 else "f4" if values.dtype.kind == "f" else "i8"
        content = values.astype(f"<{kind}").tobytes()
        offset = sum(map(len, blocks))
        blocks.append(len(content).to_bytes(8, "little") + content)
        parts = "" if values.ndim == 1 else f' NumberOfComponents="{values.shape[1]}"'
        return (
            f'<DataArray type="{_VTK_TYPES[kind]}" Name="{escape(name)}"{parts} format="appended" offset="{offset}"/>\n'
        )

    data = {"id": frame.id, "particle_type": frame.particle_type, **frame.fields}
    text = (
        f'{_HEAD.format("PolyData")}<PolyData>\n<Piece NumberOfPoints="{count}" NumberOfVerts="{count}">\n'
        f"<Points>\n{array('Points', frame.position)}</Points>\n"
        f"<Verts>\n{array('connectivity', np.arange(count))}{array('offsets', np.arange(1, count + 1))}</Verts>\n"
        f"<PointData>\n{''.join(array(name, values) for name, values in data.items())}</PointData>\n"
        '</Piece>\n</PolyData>\n<AppendedData encoding="raw">\n_'
    )
    return text.encode() + b"".join(blocks) + b"\n</AppendedData>\n</VTKFile>\n"
