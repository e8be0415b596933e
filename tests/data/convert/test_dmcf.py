import re
import sys
from pathlib import Path

import numpy as np
import pytest

from nmpm._support.messages import install
from nmpm.data.convert import Options, convert
from nmpm.data.format import Split, read_metadata
from nmpm.errors import ConfigError, DataError

msgpack = pytest.importorskip("msgpack", reason="the extra `convert` is not installed")
zstandard = pytest.importorskip("zstandard", reason="the extra `convert` is not installed")


def packed(array: np.ndarray) -> dict:
    return {b"nd": True, b"type": array.dtype.str.encode(), b"kind": b"", b"shape": list(array.shape),
            b"data": array.tobytes()}  # fmt: skip


def frames(number: int = 4, particles: int = 5) -> list[dict]:
    rng = np.random.default_rng(0)
    made = [{b"pos": packed(rng.random((particles, 3)).astype("f4")), b"scene_id": b"one",
             b"vel": packed(rng.random((particles, 3)).astype("f4"))} for _ in range(number)]  # fmt: skip
    made[0] |= {b"box": packed(rng.random((7, 3)).astype("f4")), b"box_normals": packed(rng.random((7, 3)))}
    return made


def write(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(zstandard.ZstdCompressor().compress(msgpack.packb(content)))
    return path


def test_all_values_are_converted(tmp_path):
    made = frames()
    notes = convert(write(tmp_path / "a.msgpack.zst", made), tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "test.h5").read_with_fields(0)
    assert trajectory.position.shape == (4, 12, 3)
    for index, frame in enumerate(made):
        for read, key in ((trajectory.position[index, :5], b"pos"), (trajectory.fields["vel"][index], b"vel")):
            np.testing.assert_array_equal(read, np.frombuffer(frame[key][b"data"], "<f4").reshape(5, 3))
    assert trajectory.fields["box_normals"].shape == (7, 3)
    assert trajectory.particle_type.tolist() == [0] * 5 + [1] * 7
    assert read_metadata(tmp_path / "out").gravity == (0.0, -9.81, 0.0)
    assert any("do not state dt" in note for note in notes)


def test_folders_are_splits(tmp_path):
    for split in ("train", "test"):
        write(tmp_path / "data" / split / "a.msgpack.zst", frames())
    convert(tmp_path / "data", tmp_path / "out", options=Options(dt=0.01))
    assert sorted(item.name for item in (tmp_path / "out").iterdir()) == ["metadata.json", "test.h5", "train.h5"]
    assert read_metadata(tmp_path / "out").dt == 0.01


def test_a_changing_number_of_particles_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"frame 4: 9 particles, but 5 in frame 0"):
        convert(write(tmp_path / "a.msgpack.zst", frames() + frames(1, 9)), tmp_path / "out")


def test_missing_packages_give_the_install_command(tmp_path, monkeypatch):
    path = write(tmp_path / "a.msgpack.zst", frames())
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(ConfigError, match=re.escape(install("convert"))):
        convert(path, tmp_path / "out")


def test_recorded_canyon(recorded, tmp_path):
    convert(recorded / "dmcf-canyon-3d", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "test.h5").read_with_fields(0)
    assert trajectory.position.shape == (13, 1280 + 185447, 3)
    assert trajectory.fields["vel"].shape == (13, 1280, 3)
    fluid = trajectory.position[:, trajectory.particle_type == 0]
    fall = float(np.median(np.diff(fluid[..., 1], n=2, axis=0)))
    assert fall == pytest.approx(-9.81 * 0.02**2, rel=0.05)
