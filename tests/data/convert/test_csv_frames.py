"""Tables with a file per frame."""

from pathlib import Path

import numpy as np
import pytest

from nmpm.data.convert import convert, open_dataset
from nmpm.data.format import Split
from nmpm.errors import DataError

T, N = 5, 4
HEADER = "time [s],id,x_mm,y_mm,vx_mm_s,vy_mm_s,heat"


def write_run(folder: Path, header: str = HEADER) -> np.ndarray:
    """A particle per line, in another order in each frame."""
    position = np.random.default_rng(0).random((T, N, 2)).round(4)
    folder.mkdir(parents=True)
    for t in range(T):
        rows = [
            (0.5 * t, i, *position[t, i], *(2 * position[t, i]), i + t) for i in np.random.default_rng(t).permutation(N)
        ]
        (folder / f"frame{t}.csv").write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return position


def test_columns_by_their_names(tmp_path):
    position = write_run(tmp_path / "run")
    convert(tmp_path / "run", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_array_equal(trajectory.position, position.astype("f4"))
    np.testing.assert_allclose(trajectory.fields["velocity"], 2 * position, rtol=1e-6)
    assert trajectory.fields["heat"].tolist() == [[i + t for i in range(N)] for t in range(T)]
    assert trajectory.fields["time"].tolist() == [0, 0.5, 1, 1.5, 2]


def test_tables_of_tracks_are_runs_not_frames(tmp_path):
    (tmp_path / "data").mkdir()
    for run in range(2):
        rows = [f"{0.5 * t},{i},{i + 0.1 * t},{t}" for t in range(T) for i in range(N)]
        (tmp_path / "data" / f"run{run}.csv").write_text("\n".join(["time,id,x,y", *rows]) + "\n")
    assert open_dataset(tmp_path / "data").counts == {"train": 2}


def test_a_wrong_table_is_named(tmp_path):
    write_run(tmp_path / "run")
    (tmp_path / "run" / "frame3.csv").write_text(HEADER.replace("x_mm,", "a,") + "\n1,1,1,1,1,1,1\n")
    with pytest.raises(DataError, match=r"frame3.csv: no columns x, y of coordinates \(found: time"):
        convert(tmp_path / "run", tmp_path / "out")
