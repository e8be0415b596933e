"""Files that vtk writes, by pyvista, and PLY files that plyfile writes."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nmpm.data.convert import convert
from nmpm.data.format import Split, read_metadata
from nmpm.errors import DataError

pyvista = pytest.importorskip("pyvista", reason="the extra `vtk` is not installed")
plyfile = pytest.importorskip("plyfile", reason="the extra `vtk` is not installed")

T, N = 5, 7


def positions(frames: int = T) -> np.ndarray:
    return np.random.default_rng(0).random((frames, N, 3)).astype("f4")


def cloud(position: np.ndarray, **arrays: np.ndarray) -> "pyvista.PolyData":
    points = pyvista.PolyData(np.asarray(position))
    for name, values in arrays.items():
        points.point_data[name] = values
    return points


def write_run(folder: Path, suffix: str = ".vtp", binary: bool = True) -> np.ndarray:
    folder.mkdir(parents=True)
    position = positions()
    for t, frame in enumerate(position):
        arrays = {"velocity": 2 * frame, "pressure": frame[:, 0].astype("f8"), "type": np.arange(N, dtype="u1") % 2}
        if suffix == ".ply":
            names = ("x", "y", "z", "vx", "vy", "vz")
            vertices = np.zeros(N, [*((name, "f4") for name in names), ("pressure", "f8"), ("type", "u1")])
            for name, values in zip(names, np.concatenate([frame, arrays.pop("velocity")], axis=1).T, strict=True):
                vertices[name] = values
            for name, values in arrays.items():
                vertices[name] = values
            element = plyfile.PlyElement.describe(vertices, "vertex")
            plyfile.PlyData([element], text=not binary, comments=[f"time {0.5 * t}"]).write(folder / f"frame_{t}.ply")
            continue
        mesh = cloud(frame, **arrays)
        mesh.field_data["TimeValue"] = [0.5 * t]
        mesh = mesh.cast_to_unstructured_grid() if suffix == ".vtu" else mesh
        mesh.save(folder / f"frame_{t}{suffix}", binary=binary)
    return position


@pytest.mark.parametrize(
    ("suffix", "binary"),
    [(".vtk", True), (".vtk", False), (".vtp", True), (".vtu", True), (".ply", True), (".ply", False)],
)
def test_points_arrays_and_times_are_read(tmp_path, suffix, binary):
    position = write_run(tmp_path / "data" / "train" / "run0", suffix, binary)
    convert(tmp_path / "data", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_allclose(trajectory.position, position, rtol=1e-5)
    np.testing.assert_allclose(trajectory.fields["velocity"], 2 * position, rtol=1e-5)
    np.testing.assert_allclose(trajectory.fields["pressure"], position[..., 0], rtol=1e-5)
    assert trajectory.particle_type.tolist() == [0, 1, 0, 1, 0, 1, 0]
    assert trajectory.fields["time"].tolist() == [0, 0.5, 1, 1.5, 2]
    assert read_metadata(tmp_path / "out").dt == 0.5


def write_list(folder: Path, names: list[str], times: list[float], suffix: str = ".pvd") -> Path:
    path = folder / f"run{suffix}"
    if suffix == ".vtp.series":
        files = [{"name": name, "time": time} for time, name in zip(times, names, strict=True)]
        path.write_text(json.dumps({"file-series-version": "1.0", "files": files}))
        return path
    sets = "".join(f'<DataSet timestep="{t}" part="0" file="{name}"/>' for t, name in zip(times, names, strict=True))
    path.write_text(f'<?xml version="1.0"?><VTKFile type="Collection"><Collection>{sets}</Collection></VTKFile>')
    return path


@pytest.mark.parametrize("suffix", [".pvd", ".vtp.series"])
def test_a_list_gives_order_and_times(tmp_path, suffix):
    position = write_run(tmp_path / "run" / "frames")
    written = write_list(tmp_path / "run", [f"frames/frame_{t}.vtp" for t in (3, 0, 2)], [0.3, 0.1, 0.2], suffix)
    for source in (tmp_path / "run", written):
        convert(source, tmp_path / source.name / "out")
        trajectory = Split(tmp_path / source.name / "out" / "train.h5").read_with_fields(0)
        np.testing.assert_array_equal(trajectory.position, position[[0, 2, 3]])
        assert trajectory.fields["time"].tolist() == [0.1, 0.2, 0.3]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def swap(*pairs: tuple[bytes, bytes]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        for old, new in pairs:
            path.write_bytes(path.read_bytes().replace(old, new))

    return change


declare_more = swap((b"POINTS 7", b"POINTS 700000000"), (b'OfPoints="7"', b'OfPoints="700000000"'),
                    (b"vertex 7", b"vertex 7000000000"))  # fmt: skip


@pytest.mark.parametrize("content", ["[1", "[]", '{"files": [1]}', '{"files": [{"name": "a.vtp", "time": "x"}]}'])
def test_a_series_that_is_none_is_named(tmp_path, content):
    (tmp_path / "a.vtp.series").write_text(content)
    with pytest.raises(DataError, match=r"a.vtp.series: cannot be read as a list .*; its files need name and time"):
        convert(tmp_path / "a.vtp.series", tmp_path / "out")


@pytest.mark.parametrize(
    ("suffix", "damage", "message"),
    [
        (".vtp", cut, r"cannot be read as VTK \(.*\). Is it complete\?"),
        (".vtk", cut, r"cannot be read as VTK \(.*\). Is it complete\?"),
        (".vtu", lambda path: path.write_bytes(b""), r"cannot be read as VTK \(.*\). Is it complete\?"),
        (".vtk", pyvista.ImageData(dimensions=(2, 2, 2)).save, "it has a StructuredPoints; particles are points"),
        (".vtk", declare_more, "it declares 700,000,000 points or cells but has"),
        (".vtp", declare_more, "it declares 700,000,000 points or cells but has"),
        (".vtu", swap((b'OfPoints="7"', b'OfPoints="-7"')), "it declares -7 points or cells but has"),
        (".ply", cut, r"cannot be read as PLY \(.*early end-of-file"),
        (
            ".ply",
            swap((b"float x", b"float q"), (b"float y", b"float r")),
            r"it has no element vertex with x, y \(found: vertex, q, r, z",
        ),
        (".ply", declare_more, "cannot be read as PLY"),
        (".ply", lambda path: path.write_bytes(b""), "cannot be read as PLY "),
    ],
    ids=[
        "vtp",
        "vtk",
        "empty",
        "grid",
        "size",
        "XML size",
        "negative",
        "ply",
        "ply axes",
        "ply size",
        "empty ply",
    ],
)
@pytest.mark.parametrize("frame", [1, T - 1])
def test_damaged_files_are_named(tmp_path, capfd, suffix, damage, message, frame):
    write_run(tmp_path / "run", suffix)
    damage(tmp_path / "run" / f"frame_{frame}{suffix}")
    last = "leave it out" if frame == T - 1 else ""
    with pytest.raises(DataError, match=rf"frame_{frame}\{suffix}: {message}.*{last}"):
        convert(tmp_path / "run", tmp_path / "out")
    assert "ERR" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["../other.vtp"], "names .*other.vtp, which is not in its folder"),
        (["frame_0.vtp", "frame_9.vtp"], "frame_9.vtp cannot be read: No such file"),
        ([], "it lists no file"),
    ],
    ids=["outside", "missing", "none"],
)
def test_wrong_lists(tmp_path, names, message):
    write_run(tmp_path / "run")
    with pytest.raises(DataError, match=message):
        convert(write_list(tmp_path / "run", names, list(range(len(names)))), tmp_path / "out")


POINTS = (
    '<VTKFile type="PolyData" version="0.1"><PolyData><Piece NumberOfPoints="3"><Points><DataArray type="Float32"'
    ' NumberOfComponents="3" format="ascii">0 0 0 1 0 0 0 1 0</DataArray></Points></Piece></PolyData></VTKFile>'
)


def write_parts(folder: Path, source: str) -> Path:
    (folder / "data" / "parts").mkdir(parents=True)
    for place in (folder / "secret.vtp", folder / "data" / "parts" / "part.vtp"):
        place.write_text(POINTS)
    points = '<PPoints><PDataArray type="Float32" NumberOfComponents="3"/></PPoints>'
    text = f'<VTKFile type="PPolyData" version="0.1"><PPolyData>{points}<Piece Source={source}/></PPolyData></VTKFile>'
    for frame in range(3):
        (folder / "data" / f"frame_{frame}.vtp").write_text(text)
    return folder / "data"


def test_parts_in_the_folder_are_read(tmp_path):
    convert(write_parts(tmp_path, '"parts/part.vtp"'), tmp_path / "out")
    assert Split(tmp_path / "out" / "train.h5").read(0).position.shape == (3, 3, 2)


@pytest.mark.parametrize(
    "source", ['"../secret.vtp"', "'../secret.vtp'", '"parts/../../secret.vtp"', '"&#46;./secret.vtp"']
)
def test_parts_elsewhere_are_not_read(tmp_path, source):
    with pytest.raises(DataError, match=r"frame_0\.vtp: it names .*secret.vtp, which is not in its folder"):
        convert(write_parts(tmp_path, source), tmp_path / "out")
    frame, part = tmp_path / "data" / "frame_0.vtp", tmp_path / "data" / "parts" / "part.vtp"
    part.write_text(frame.read_text())
    frame.write_text(frame.read_text().replace(source, '"parts/part.vtp"'))
    with pytest.raises(DataError, match=r"part\.vtp.* not in its folder|names parts itself"):
        convert(tmp_path / "data", tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "other"),
    [
        ('NumberOfPoints="3"', "NumberOfPoints='2000000000'"),
        ('NumberOfPoints="3"', "NumberOfPoints = \n '  +2000000000 '"),
        ('NumberOfPoints="3"', 'NumberOfPoints="&#50;000000000"'),
        ('<Piece NumberOfPoints="3"', f'<!--{"x" * 10**6}--><Piece NumberOfPoints="2000000000"'),
        ('NumberOfComponents="3"', "NumberOfComponents='900000000'"),
        ('NumberOfPoints="3"', "NumberOfPoints='40000000'"),
        ('<VTKFile type="PolyData"', '<!DOCTYPE VTKFile [<!ENTITY n "2000000000">]><VTKFile type="PolyData"'),
        ('type="PolyData"', 'type="vtkMultiBlockDataSet"'),
    ],
    ids=["quotes", "blanks", "entity", "comment", "components", "product", "doctype", "kind"],
)
def test_sizes_are_checked_in_every_spelling_of_xml(tmp_path, text, other):
    (tmp_path / "run").mkdir()
    for frame in range(3):
        (tmp_path / "run" / f"frame_{frame}.vtp").write_text(POINTS.replace(text, other))
    with pytest.raises(DataError, match=r"frame_0\.vtp: (it declares|it has a vtkMulti|.*document type)"):
        convert(tmp_path / "run", tmp_path / "out")


def test_recorded_sph(recorded, tmp_path):
    convert(recorded / "third-party" / "warp-sph-vtk", tmp_path / "out")
    counts = {name: len(Split(tmp_path / "out" / f"{name}.h5")) for name in ("train", "valid", "test")}
    assert counts == {"train": 3, "valid": 1, "test": 1}
    trajectory = Split(tmp_path / "out" / "test.h5").read_with_fields(0)
    assert trajectory.position.shape == trajectory.fields["velocity"].shape == (60, 2048, 3)
