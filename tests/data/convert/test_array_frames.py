"""Arrays of a frame: a file, or a group, for each."""

from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm.data.convert import convert, open_dataset
from nmpm.data.format import Split, read_metadata
from nmpm.errors import DataError

T, N = 12, 6
RUN = np.random.default_rng(0).random((T, N, 3))
WALL = np.random.default_rng(1).random((1, 3, 3)).repeat(T, axis=0)


def npy(path: Path, t: int) -> None:
    np.save(path / f"frame_{t:04}.npy", RUN[t])


def npz(path: Path, t: int) -> None:
    """As GeoTaichi."""
    np.savez(
        path / f"MPMParticle{t:06}.npz",
        t_current=np.array([0.01 * t]),
        position=RUN[t],
        velocity=RUN[t],
        volume=RUN[t, :, 0],
    )


def one_frame_of_one_run(path: Path, t: int) -> None:
    np.savez(path / f"{t}.npz", positions=RUN[t : t + 1], time=0.01 * t)


def components(path: Path, t: int) -> None:
    """As PySPH."""
    with h5py.File(path / f"dam_{100 * t}.hdf5", "w") as file:
        file.create_group("solver_data").attrs.update({"t": 0.01 * t, "dt": 1e-4, "count": 100 * t})
        arrays = {name: RUN[t, :, axis] for axis, name in enumerate("xyz")}
        file.update({f"particles/fluid/arrays/{name}": array for name, array in arrays.items()})
        file.update({f"particles/fluid/arrays/{name}": RUN[t, :, 0] for name in "uvw"})


def table(path: Path, t: int) -> None:
    """As CB-Geo."""
    names = ["coord_x", "coord_y", "coord_z", "velocity_x", "velocity_y", "velocity_z"]
    rows = np.zeros(N, [("id", "i8"), *((name, "f8") for name in names)])
    order = np.random.default_rng(t).permutation(N)
    rows["id"] = order
    for axis in range(3):
        rows[names[axis]] = rows[names[axis + 3]] = RUN[t, order, axis]
    with h5py.File(path / f"particles{t:02}.h5", "w") as file:
        file["table"] = rows


@pytest.mark.parametrize("write", [npy, npz, one_frame_of_one_run, components, table], ids=lambda write: write.__name__)
def test_a_file_per_frame(tmp_path: Path, write: Callable[[Path, int], None]) -> None:
    (tmp_path / "data" / "run").mkdir(parents=True)
    for t in range(T):
        write(tmp_path / "data" / "run", t)
    convert(tmp_path / "data", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_array_equal(trajectory.position, RUN.astype("f4"))
    assert ("velocity" in trajectory.fields) == (write in (npz, components, table))
    if "time" in trajectory.fields:
        np.testing.assert_allclose(trajectory.fields["time"], 0.01 * np.arange(T))
        assert read_metadata(tmp_path / "out").dt == pytest.approx(0.01)


def groups(file: Path) -> None:
    with h5py.File(file, "w") as content:
        for t in reversed(range(T)):
            content[f"frame_{t}/pos"] = RUN[t]
            content[f"frame_{t}"].attrs["time"] = 0.01 * t


def h5part(file: Path) -> None:
    with h5py.File(file, "w") as content:
        for t in range(T):
            content.update({f"Step#{t}/{name}": RUN[t, :, axis] for axis, name in enumerate("xyz")})


def arrays(file: Path) -> None:
    np.savez(file.with_suffix(".npz"), *RUN)


@pytest.mark.parametrize("write", [groups, h5part, arrays], ids=lambda write: write.__name__)
def test_many_frames_in_a_file(tmp_path: Path, write: Callable[[Path], None]) -> None:
    (tmp_path / "data").mkdir()
    write(tmp_path / "data" / "run.h5")
    convert(tmp_path / "data", tmp_path / "out")
    np.testing.assert_array_equal(Split(tmp_path / "out" / "train.h5").read(0).position, RUN.astype("f4"))


def save(path: Path, content: Mapping[str, np.ndarray]) -> None:
    with h5py.File(path, "w") as file:
        file.update(content)


def test_groups_are_materials_and_grids_are_none(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    for t in range(T):
        ids = {"particles/fluid/id": np.arange(N), "particles/wall/id": np.arange(3)}
        positions = {"particles/fluid/x": RUN[t], "particles/wall/x": WALL[t], "grid/position": np.zeros((9, 3))}
        save(tmp_path / "data" / f"out_{t}.h5", ids | positions)
    convert(tmp_path / "data", tmp_path / "out")
    trajectory, metadata = Split(tmp_path / "out" / "train.h5").read(0), read_metadata(tmp_path / "out")
    assert metadata.particle_types == {0: "fluid", 1: "wall"}
    assert metadata.static_types == {1}
    np.testing.assert_array_equal(trajectory.particle_type, [0] * N + [1] * 3)
    np.testing.assert_array_equal(trajectory.position, np.concatenate([RUN, WALL], axis=1).astype("f4"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"positions": RUN[0]}, r"this is one frame.*np\.stack\(frames\)"),
        ({"x": RUN[0, :, 0], "y": RUN[0, :-1, 1]}, r"positions are \(T, N, D\)"),
    ],
    ids=["alone", "lengths"],
)
def test_one_frame_is_no_run(tmp_path: Path, content: Mapping[str, np.ndarray], message: str) -> None:
    save(tmp_path / "a.h5", content)
    with pytest.raises(DataError, match=message):
        open_dataset(tmp_path / "a.h5")
