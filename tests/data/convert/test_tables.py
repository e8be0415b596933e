"""Tables of tracks, as particle tracking writes them, and tables with a file per frame."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from nmpm.data.convert import convert, open_dataset
from nmpm.data.convert.tables import plain_column
from nmpm.data.format import Split, read_metadata
from nmpm.errors import DataError

FRAMES, TRACKS = 10, 4


def made(seed: int = 0, dim: int = 2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 1, (1, TRACKS, dim)) + 0.01 * np.cumsum(rng.normal(size=(FRAMES, TRACKS, dim)), axis=0)


def lines(position: np.ndarray, header: str = "frame,particle,x,y", seed: int = 0, more: str = "") -> list[str]:
    """Rows in any order."""
    rows = [
        ",".join([str(frame), str(particle), *(f"{value:.6f}" for value in position[frame, particle])]) + more
        for frame in range(len(position))
        for particle in range(position.shape[1])
        if not np.isnan(position[frame, particle]).any()
    ]
    return [header, *np.random.default_rng(seed).permutation(rows).tolist()]


def write(path: Path, rows: list[str]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "wt", encoding="utf-8") as file:
        file.write("\n".join(rows) + "\n")
    return path


def read(path: Path, split: str = "train", index: int = 0):
    return list(open_dataset(path).splits[split]())[index]


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz", "a.tsv", "a.txt", "a.parquet"])
def test_tracks_in_every_kind_of_file(tmp_path, name):
    position, path = made(), tmp_path / name
    position[:3, 1] = position[7:, 2] = position[4, 0] = np.nan
    rows = lines(position)
    if name == "a.parquet":
        table, parquet = pytest.importorskip("pyarrow.csv"), pytest.importorskip("pyarrow.parquet")
        parquet.write_table(table.read_csv(write(tmp_path / "a.csv", rows)), path)
    else:
        write(path, [row.replace(",", {".tsv": "\t", ".txt": " "}.get(path.suffix, ",")) for row in rows])
    run = read(path)
    np.testing.assert_allclose(run.position, position, atol=1e-6)
    assert list(run.fields) == ["id"]


def test_columns_are_known_by_usual_names_with_units(tmp_path):
    names = "Time [s];TRACK_ID;POSITION_X;POSITION_Y;POSITION_Z;v_x (m/s);v_y (m/s);v_z (m/s);material;Diameter_um;note"
    units = ";".join(["", "", *["(mm)"] * 3, *[""] * 6])  # as TrackMate has below its header
    position = made(dim=3)
    rows = [
        ";".join(
            map(str, [frame * 0.5, track, *position[frame, track], 1, 2, 3, "sand" if track else "mud", track, "a"])
        )
        for frame in range(FRAMES)
        for track in range(TRACKS)
    ]
    path = write(tmp_path / "spots.csv", [names, units, *rows])
    run, metadata = read(path), open_dataset(path).metadata
    np.testing.assert_allclose(run.position, position, atol=1e-6)
    assert [metadata.particle_types[i] for i in run.particle_type] == ["mud", "sand", "sand", "sand"]
    assert run.fields["velocity"][3, 2].tolist() == [1, 2, 3]
    assert run.fields["Diameter_um"].tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(run.fields["time"], 0.5 * np.arange(FRAMES))
    assert [plain_column(name) for name in ("x_mm", "vx_mm/s", "Frame", "y (px)", "x_min")] == [
        "x", "vx", "frame", "y", "xmin",
    ]  # fmt: skip


def test_missing_frames_of_a_grid_are_empty_and_other_times_are_kept(tmp_path):
    position, header = made(), "t,id,x,y"
    even, uneven = np.arange(FRAMES) * 0.004 + 1, np.cumsum(np.linspace(1, 3, FRAMES))
    for times, name in ((even, "even.csv"), (uneven, "uneven.csv")):
        rows = [
            f"{times[frame]:.4f},{track},{x},{y}"
            for frame in range(FRAMES)
            if frame not in (4, 7)
            for track, (x, y) in enumerate(position[frame])
        ]
        run = read(write(tmp_path / name, [header, *rows]))
        empty = np.flatnonzero(np.isnan(run.position[..., 0]).all(axis=1)).tolist()
        if name == "even.csv":
            assert empty == [4, 7]
            np.testing.assert_allclose(run.fields["time"], times)
        else:
            assert not empty
            np.testing.assert_allclose(run.fields["time"], np.delete(times, (4, 7)), atol=1e-4)


def test_runs_are_told_apart_and_divided(tmp_path):
    rows = ["experiment,frame,id,x,y"]
    for index in range(4):
        rows += [f"{index},{row}" for row in lines(made(index), seed=index)[1:]]
    path = write(tmp_path / "all.csv", rows)
    dataset = open_dataset(path)
    assert dataset.counts == {"train": 2, "valid": 1, "test": 1}
    np.testing.assert_allclose(read(path, "test").position, made(3), atol=1e-6)
    with pytest.raises(DataError, match=r"rows of experiment 0 do not follow each other. Sort the table by experiment"):
        open_dataset(write(tmp_path / "mixed.csv", [*rows, rows[1]]))
    for split in ("train", "valid"):
        write(tmp_path / "folder" / split / "a.csv", lines(made()))
    assert set(open_dataset(tmp_path / "folder").splits) == {"train", "valid"}


def test_short_tracks_share_slots(tmp_path):
    position = np.full((60, 30, 2), np.nan)
    for track in range(30):  # two at a time
        first = 2 * track
        position[first : first + 4, track] = np.random.default_rng(track).random((min(4, 60 - first), 2))
    path = write(tmp_path / "tracks.csv", lines(position))
    run = read(path)
    slots = run.position.shape[1]
    assert slots < 6
    present = ~np.isnan(run.position[..., 0])
    track = run.fields["track"]
    for frame, slot in np.argwhere(present):
        np.testing.assert_allclose(run.position[frame, slot], position[frame, track[frame, slot]], atol=1e-6)
    assert present.sum() == (~np.isnan(position[..., 0])).sum()
    changes = (track[1:] != track[:-1]) & present[1:] & present[:-1]
    assert not changes.any()
    convert(path, tmp_path / "out")
    assert Split(tmp_path / "out" / "train.h5").particles(0) == slots
    assert read_metadata(tmp_path / "out").dim == 2


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([*lines(made()), "3,2,0.5,0.5"], r"rows \d+ and 41 are both track 2 in frame 3"),
        ([*lines(made()), "3,2,0.5"], r"a\.csv, line 42: it has 3 cells, the header has 4"),
        ([*lines(made()), "3,2,a,0.5"], r"the column x must contain numbers, but has 'a'"),
        (lines(made(), "frame,name,x,y"), r"no column id \(columns: frame, name, x, y\)"),
        (["frame,particle,x,y"], r"a\.csv: its run 0 is missing, or empty"),
    ],
    ids=["twice", "cells", "text", "id", "empty"],
)
def test_bad_rows_are_refused_by_number(tmp_path, rows, message):
    path = write(tmp_path / "a.csv", rows)
    with pytest.raises(DataError, match=message):
        list(open_dataset(path, "tracks").splits["train"]())


def test_rows_without_a_track_are_left_out_with_a_warning(tmp_path, caplog):
    run = read(write(tmp_path / "a.csv", [*lines(made()), "3,,0.5,0.5"]))
    np.testing.assert_allclose(run.position, made(), atol=1e-6)
    assert "1 row without particle left out" in caplog.text


def test_a_sample_of_tracks_is_read(recorded):
    runs = [read(recorded / "third-party" / "ptv-tracks", split) for split in ("train", "valid", "test")]
    assert [len(run.position) for run in runs] == [128, 16, 16]
    assert sum(np.isnan(run.position[..., 0]).all(axis=1).sum() for run in runs) == 2
    assert sum(np.isfinite(run.position[..., 0]).sum() for run in runs) == 65_577


def test_tables_of_pandas_and_of_track_mate_are_read(tmp_path):
    header, *rows = lines(made())
    indexed = [f",{header}", *(f"{index},{row}" for index, row in enumerate(rows))]
    np.testing.assert_allclose(read(write(tmp_path / "pandas.csv", indexed)).position, made(), atol=1e-6)
    labelled = [header, "Frame,Spot ID,X,Y", ",,(mm),(mm)", *rows]
    np.testing.assert_allclose(read(write(tmp_path / "mate.csv", labelled)).position, made(), atol=1e-6)
    quoted = [header, *(",".join(f'"{cell}"' for cell in row.split(",")) for row in rows)]
    np.testing.assert_allclose(read(write(tmp_path / "quoted.csv", quoted)).position, made(), atol=1e-6)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz"])
@pytest.mark.parametrize("separator", [";", "\t"])
def test_tables_as_spreadsheets_save_them(tmp_path, encoding, name, separator):
    position = made()
    table = "\r\n".join(["sep=" + separator, *(row.replace(",", separator) for row in lines(position))])
    content = table.replace(".", ",").encode(encoding)
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    np.testing.assert_allclose(read(tmp_path / name).position, position, atol=1e-6)


def test_other_dates_and_commas_are_refused_with_the_mend(tmp_path):
    rows = ["time,id,x,y", "31.05.2026 12:00,1,0.5,0.5"]
    with pytest.raises(DataError, match=r"column time must contain numbers, or dates such as 2026-05-31T12.*'31\.05\."):
        read(write(tmp_path / "a.csv", rows))
    with pytest.raises(DataError, match=r"line 2: it has 6 cells, the header has 4. If commas are decimal, separate"):
        read(write(tmp_path / "b.csv", ["frame,id,x,y", "0,1,0,5,0,25"]))
    with pytest.raises(DataError, match=r"the column x must contain numbers, but has 'left'"):
        read(write(tmp_path / "c.csv", ["frame,id,x,y", "0,1,left,0.25"]))


HEADER = "time [s],id,x_mm,y_mm,vx_mm_s,vy_mm_s,heat"


def write_run(folder: Path, header: str = HEADER) -> np.ndarray:
    """A particle per line, in another order in each frame."""
    position = np.random.default_rng(0).random((FRAMES, TRACKS, 2)).round(4)
    folder.mkdir(parents=True)
    for t in range(FRAMES):
        rows = [
            (0.5 * t, i, *position[t, i], *(2 * position[t, i]), i + t)
            for i in np.random.default_rng(t).permutation(TRACKS)
        ]
        (folder / f"frame{t}.csv").write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return position


def test_columns_by_their_names(tmp_path):
    position = write_run(tmp_path / "run")
    convert(tmp_path / "run", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_array_equal(trajectory.position, position.astype("f4"))
    np.testing.assert_allclose(trajectory.fields["velocity"], 2 * position, rtol=1e-6)
    assert trajectory.fields["heat"].tolist() == [[i + t for i in range(TRACKS)] for t in range(FRAMES)]
    assert trajectory.fields["time"].tolist() == (0.5 * np.arange(FRAMES)).tolist()


def test_tables_of_tracks_are_runs_not_frames(tmp_path):
    (tmp_path / "data").mkdir()
    for run in range(2):
        rows = [f"{0.5 * t},{i},{i + 0.1 * t},{t}" for t in range(FRAMES) for i in range(TRACKS)]
        (tmp_path / "data" / f"run{run}.csv").write_text("\n".join(["time,id,x,y", *rows]) + "\n")
    assert open_dataset(tmp_path / "data").counts == {"train": 2}


def test_a_wrong_table_is_named(tmp_path):
    write_run(tmp_path / "run")
    (tmp_path / "run" / "frame3.csv").write_text(HEADER.replace("x_mm,", "a,") + "\n1,1,1,1,1,1,1\n")
    with pytest.raises(DataError, match=r"frame3.csv: no columns x, y of coordinates \(found: time"):
        convert(tmp_path / "run", tmp_path / "out")
