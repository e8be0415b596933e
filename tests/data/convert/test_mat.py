"""MATLAB's files, old ones as scipy writes them, and v7.3 ones, which are HDF5 with axes the other way round."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from nmpm.data.convert import open_dataset
from nmpm.errors import DataError

T, N = 12, 5


def made(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 1, (1, N, 2)) + np.cumsum(rng.normal(0, 1e-3, (T, N, 2)), axis=0)


def write_v73(path: Path, arrays: dict, cells: dict) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in arrays.items():
            file[name] = np.atleast_2d(np.asarray(values, float)).T
        for name, runs in cells.items():
            inside = [file.create_dataset(f"#refs#/{chr(97 + i)}", data=run.T).ref for i, run in enumerate(runs)]
            file.create_dataset(name, data=np.array([inside], h5py.ref_dtype).T, dtype=h5py.ref_dtype)
        file["note"] = np.frombuffer("mm".encode("utf-16-le"), np.uint16)[:, None]
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")


@pytest.mark.parametrize("old", [True, False])
def test_arrays_structs_and_cells_are_read(tmp_path, old):
    runs, facts = [made(seed) for seed in range(4)], {"dt": 0.02, "types": np.array([[1.0], [1], [2], [2], [2]])}
    for name, content in (("one", {"position": runs[0]}), ("many", {})):
        path, cells = tmp_path / f"{name}.mat", {} if content else {"runs": runs}
        if old:
            cell = np.empty((1, len(runs)), object)
            cell[0] = [*runs]
            scipy.io.savemat(path, {**content, **facts, "note": "mm", **({} if content else {"runs": cell})})
        else:
            write_v73(path, {**content, **facts}, cells)
        dataset = open_dataset(path)
        read = [
            run for split in ("train", "valid", "test") if split in dataset.splits for run in dataset.splits[split]()
        ]
        assert (len(read), dataset.metadata.dt) == (1 if content else 4, 0.02)
        for run, expected in zip(read, runs, strict=False):
            np.testing.assert_allclose(run.position, expected, rtol=1e-6)
            assert run.particle_type.tolist() == [1, 1, 2, 2, 2]


def test_damaged_files_are_named(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"position": made(0)}, do_compression=True)
    content = bytearray((tmp_path / "a.mat").read_bytes())
    content[200:] = bytes(len(content) - 200)
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.mat: cannot be read as a MATLAB file"):
        open_dataset(tmp_path / "a.mat")
