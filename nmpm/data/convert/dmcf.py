"""DMCF's scenes: `*.msgpack.zst`, a compressed stream of frames.

Prantl et al., "Guaranteed conservation of momentum for learning particle-based fluid dynamics", 2022.

A file is one trajectory: a MessagePack array of maps with `pos` and `vel` (N, D), in the first also `box` and
`box_normals` (M, D), the solid boundary. The y axis points up.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.bounded_files import EXPANSION, check_regular, expansion_limit
from nmpm._support.machine import check_fits
from nmpm._support.messages import install, one_line
from nmpm.data.convert.base import UNKNOWN_LENGTH, Facts, Options, RunFiles, located, readable
from nmpm.data.families import find_family
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.statistics import extent_of
from nmpm.errors import ConfigError, DataError

_FLUID, _WALL = 0, 1
_DT, _GRAVITY = 0.02, -9.81
_FRAME_BYTES = 2**27
_ITEMS = 256  # of a list or map
_KIND = re.compile(rb"[<>|=]?[biuf]\d{1,2}")


class Dmcf(RunFiles):
    """A file per trajectory; particle type 0 is the fluid, type 1 the solid boundary."""

    summary: ClassVar[str] = "DMCF's *.msgpack.zst files (extra convert)"
    patterns: tuple[str, ...] = ("*.msgpack.zst",)
    fixed_names: ClassVar[bool] = True
    family: ClassVar[str] = "lagrangebench"

    def facts(self, file: Path, options: Options) -> Facts:
        first = next(_frames(file), {})
        position = _array(first, "pos", f"{file}, frame 0")
        dim = position.shape[1]
        everything = np.concatenate([position, _wall(first, dim, file)])
        metadata = Metadata(
            bounds=extent_of(everything[None]).intervals,
            dt=_DT,
            dim=dim,
            sequence_length=UNKNOWN_LENGTH,
            particle_types=dict(find_family(options.family or self.family).types),
            static_types=frozenset({_WALL}),
            gravity=tuple(_GRAVITY if axis == 1 else 0.0 for axis in range(dim)),
        )
        notes = (
            f"The fluid becomes particle type {_FLUID}, the solid boundary type {_WALL}.",
            *(() if options.dt else (f"The files do not state dt; {_DT:g} s is assumed (--dt).",)),
            *(() if options.gravity else (f"The files do not state gravity; {_GRAVITY:g} along y is assumed.",)),
        )
        return Facts(metadata, notes=notes, assumed=frozenset({"dt", "gravity"}))

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:  # noqa: ARG002
        frames = list(_frames(file))
        if not frames:
            raise DataError(f"{file}: the file has no frame.")
        positions, first = [_array(frame, "pos", f"{file}, frame {i}") for i, frame in enumerate(frames)], frames[0]
        changed = [index for index, position in enumerate(positions) if position.shape != positions[0].shape]
        if changed:
            raise DataError(
                f"{file}, frame {changed[0]}: {positions[changed[0]].shape[0]} particles, but {positions[0].shape[0]}"
                " in frame 0. A trajectory has a fixed number of particles; cut it where the number changes."
            )
        fluid = np.stack(positions)
        wall = _wall(first, fluid.shape[2], file)
        check_fits(len(fluid), len(wall), fluid.shape[2], str(file))
        kinds = np.repeat([_FLUID, _WALL], [fluid.shape[1], len(wall)]).astype(np.int64)
        still = np.broadcast_to(wall, (len(fluid), *wall.shape))
        attributes: dict[str, Any] = {key: np.bytes_(value) for key, value in first.items() if isinstance(value, bytes)}
        gravity = first.get("grav")
        if isinstance(gravity, np.ndarray) and gravity.shape == (fluid.shape[2],):
            attributes["gravity"] = gravity.astype(np.float64)
        fields = {}  # (T, …) where all frames have one of equal shape, else that of the first frame
        for key, value in first.items():
            if key not in ("pos", "box") and isinstance(value, np.ndarray):
                values: list[Any] = [frame.get(key) for frame in frames]
                same = all(isinstance(item, np.ndarray) and item.shape == value.shape for item in values)
                fields[key] = np.stack(values) if same else value
        with located(file):
            yield Trajectory(np.concatenate([fluid, still], axis=1).astype(np.float32), kinds, attributes, fields)


def _frames(path: Path) -> Iterator[dict[str, Any]]:
    """Yields the frames of a file; errors name the file."""
    try:
        import msgpack
        import zstandard
    except ImportError as error:
        raise ConfigError(f"{path}: reading it needs more packages: {install('convert')}.") from error
    check_regular(path)
    with (
        readable(path, "DMCF's frames", zstandard.ZstdError, msgpack.UnpackException, RecursionError),
        path.open("rb") as file,
        zstandard.ZstdDecompressor().stream_reader(file) as stream,
    ):
        reader = msgpack.Unpacker(
            stream, raw=True, max_buffer_size=_FRAME_BYTES, max_array_len=_ITEMS, max_map_len=_ITEMS
        )
        for index in range(reader.read_array_header()):
            frame, where = reader.unpack(), f"{path}, frame {index}"
            if not isinstance(frame, dict) or not all(isinstance(key, bytes) for key in frame):
                raise DataError(f"{where}: expected a map with names, found {type(frame).__name__}.")
            yield {key.decode("utf-8", "replace"): _value(value, f"{where}, {key!r}") for key, value in frame.items()}
            if reader.tell() > expansion_limit(path.stat().st_size):
                raise ValueError(f"it unpacks to more than {EXPANSION} times its size")


def _value(value: Any, where: str) -> Any:
    """Decodes an array from msgpack-numpy's map; other values stay."""
    if not isinstance(value, dict) or b"nd" not in value:
        return value
    try:
        code, shape = value[b"type"], value[b"shape"] if value[b"nd"] else []
        if not isinstance(code, bytes) or not _KIND.fullmatch(code):
            raise ValueError("expected numbers")
        if not isinstance(shape, list) or not all(isinstance(side, int) and side >= 0 for side in shape):
            raise ValueError("its shape is not a list of sizes")
        return np.frombuffer(value[b"data"], code.decode("ascii")).reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{where}: not an array as msgpack-numpy writes it ({one_line(error, 100)}).") from error


def _array(frame: dict[str, Any], name: str, where: str) -> np.ndarray:
    array = frame.get(name)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or 0 in array.shape or array.dtype.kind != "f":
        raise DataError(f"{where}: {name!r} must be floats of shape (N, D).")
    return array


def _wall(first: dict[str, Any], dim: int, path: Path) -> np.ndarray:
    """The solid boundary, (M, D); M = 0 where the first frame has none."""
    if "box" not in first:
        return np.empty((0, dim), np.float32)
    wall = _array(first, "box", f"{path}, frame 0")
    if wall.shape[1] != dim:
        raise DataError(f"{path}: 'box' has {wall.shape[1]} axes, 'pos' has {dim}.")
    return wall
