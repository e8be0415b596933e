"""PLY files that plyfile writes."""

from pathlib import Path

import numpy as np
import pytest

from nmpm.data.convert import convert
from nmpm.data.format import Split
from nmpm.errors import DataError

plyfile = pytest.importorskip("plyfile", reason="the extra `vtk` is not installed")

T, N = 4, 5


def write_run(folder: Path, text: bool = False) -> np.ndarray:
    folder.mkdir()
    position = np.random.default_rng(0).random((T, N, 3)).astype("f4")
    for t, frame in enumerate(position):
        kinds = [(name, "f4") for name in ("x", "y", "z", "vx", "vy", "vz")] + [("id", "i4"), ("red", "u1")]
        vertices = np.zeros(N, kinds)
        for axis, name in enumerate("xyz"):
            vertices[name], vertices[f"v{name}"] = frame[:, axis], 2 * frame[:, axis]
        vertices["id"], vertices["red"] = np.arange(N), t
        element = plyfile.PlyElement.describe(vertices[::-1].copy() if t % 2 else vertices, "vertex")
        plyfile.PlyData([element], text=text, comments=[f"time {0.5 * t}"]).write(str(folder / f"f{t}.ply"))
    return position


@pytest.mark.parametrize("text", [True, False])
def test_vertices_and_their_properties(tmp_path, text):
    position = write_run(tmp_path / "run", text)
    convert(tmp_path / "run", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_allclose(trajectory.position, position, rtol=1e-6)
    np.testing.assert_allclose(trajectory.fields["velocity"], 2 * position, rtol=1e-6)
    assert trajectory.fields["red"].tolist() == [[t] * N for t in range(T)]
    assert trajectory.fields["time"].tolist() == [0, 0.5, 1, 1.5]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def rename_axes(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"float x", b"float q").replace(b"float y", b"float r"))


def declare_more(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"vertex 5", b"vertex 5000000000"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut, r"cannot be read as PLY \(.*early end-of-file"),
        (rename_axes, r"it has no element vertex with x, y \(found: vertex, q, r, z"),
        (declare_more, r"cannot be read as PLY"),
        (lambda path: path.write_bytes(b""), r"cannot be read as PLY .*leave it out"),
    ],
    ids=["cut", "axes", "size", "empty"],
)
def test_damaged_files_are_named(tmp_path, damage, message):
    write_run(tmp_path / "run")
    damage(tmp_path / "run" / f"f{T - 1}.ply")
    with pytest.raises(DataError, match=f"f{T - 1}.ply: {message}"):
        convert(tmp_path / "run", tmp_path / "out")
