"""GSD files that gsd writes."""

import random
from pathlib import Path

import numpy as np
import pytest

from nmpm.data.convert import convert, open_dataset
from nmpm.data.format import Split, read_metadata
from nmpm.errors import DataError, NmpmError
from tests.data.fuzzing import damage, random_changes

fl = pytest.importorskip("gsd.fl", reason="the extra `gsd` is not installed")
T, N = 8, 5
RUN = np.random.default_rng(0).uniform(-1, 1, (T, N, 3)).astype("f4")


def write(path: Path, box: list[float] | None = None, types: bytes = b"A\0BB") -> Path:
    """As HOOMD: what does not change is in the first frame only."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with fl.open(str(path), "w", "test", "hoomd", (1, 4)) as file:
        for t in range(T):
            file.write_chunk("configuration/step", np.array([100 * t], "u8"))
            if t == 0:
                file.write_chunk("particles/N", np.array([N], "u4"))
                file.write_chunk("particles/typeid", np.arange(N, dtype="u4") % 2)
                file.write_chunk("particles/types", np.frombuffer(types, "i1").reshape(2, 2))
                if box:
                    file.write_chunk("configuration/box", np.array(box, "f4"))
            file.write_chunk("particles/position", RUN[t])
            file.write_chunk("particles/velocity", 2 * RUN[t])
            file.end_frame()
    return path


def test_positions_types_and_box(tmp_path):
    for run in range(3):
        write(tmp_path / "data" / f"run{run}.gsd", [2, 2, 2, 0, 0, 0])
    assert open_dataset(tmp_path / "data").counts == {"train": 1, "valid": 1, "test": 1}
    convert(tmp_path / "data", tmp_path / "out")
    trajectory, metadata = Split(tmp_path / "out" / "train.h5").read_with_fields(0), read_metadata(tmp_path / "out")
    np.testing.assert_array_equal(trajectory.position, RUN)
    np.testing.assert_array_equal(trajectory.fields["velocity"], 2 * RUN)
    assert trajectory.particle_type.tolist() == [0, 1, 0, 1, 0]
    assert metadata.particle_types == {0: "A", 1: "BB"}
    assert (metadata.bounds, metadata.boundary) == (((-1.0, 1.0),) * 3, ("periodic",) * 3)


def test_a_file_without_a_box_states_none(tmp_path):
    convert(write(tmp_path / "run.gsd"), tmp_path / "out")
    assert read_metadata(tmp_path / "out").boundary == ("wall",) * 3


def test_what_cannot_be_read_is_named(tmp_path):
    with pytest.raises(DataError, match=r"run.gsd, frame 0: its box is triclinic \(tilt 0.5\)"):
        convert(write(tmp_path / "run.gsd", [2, 2, 2, 0, 0.5, 0]), tmp_path / "out")
    path = write(tmp_path / "cut.gsd")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(DataError, match=r"cut.gsd: cannot be read"):
        convert(path, tmp_path / "out", "gsd")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_damaged_files_give_typed_errors(tmp_path):
    """Also where gsd itself crashes, as of seed 265."""
    path = write(tmp_path / "run.gsd", [2, 2, 2, 0, 0, 0])
    content, errors = path.read_bytes(), list[str]()
    for seed in range(225, 325):
        path.write_bytes(damage(content, random_changes(random.Random(f"gsd {seed}"))))
        try:
            for start in open_dataset(path).splits.values():
                list(start())
        except NmpmError as error:
            errors.append(str(error))
    assert len(errors) > 20
    assert not [error for error in errors if "\n" in error]
