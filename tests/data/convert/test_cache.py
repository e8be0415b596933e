import json
import os

import numpy as np
import pytest

from nmpm.data.convert import Options
from nmpm.data.convert.cache import native_folder
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.format import read_metadata
from nmpm.errors import ConfigError
from tests.data.convert import records
from tests.data.convert.test_deepmind import METADATA, made


@pytest.fixture
def foreign(tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    folder = tmp_path / "ramps"
    for split in ("train", "valid", "test"):
        records.write_records(folder / f"{split}.tfrecord", records.trajectory_record(*made(frames=8)))
    (folder / "metadata.json").write_text(json.dumps(METADATA))
    return folder


def test_is_converted_once_and_again_after_a_change(foreign):
    first = native_folder(foreign)
    stamp = (first / "train.h5").stat().st_mtime_ns
    assert native_folder(foreign) == first
    assert (first / "train.h5").stat().st_mtime_ns == stamp
    assert native_folder(foreign, Options(gravity=(0.0, -9.81))) != first
    os.utime(foreign / "train.tfrecord", ns=(1, 1))
    assert native_folder(foreign) != first


def test_other_formats_can_be_trained_on_directly(foreign):
    data = TrajectoryDataModule(path=str(foreign), gravity=[0.0, -9.81], horizon=4, batch_size=1)
    data.prepare_data()
    data.setup("fit")
    batch = next(iter(data.train_dataloader()))
    assert data.scene.obstacles
    assert data.scene.gravity == (0.0, -9.81)
    position, _ = made(frames=8)
    frames = batch.initial.position[0].numpy()
    assert any(np.allclose(frames, position[i, :3], atol=1e-7) for i in range(8))


def test_a_gravity_that_contradicts_a_foreign_format_is_refused(foreign):
    (foreign / "metadata.json").write_text(json.dumps(METADATA | {"gravity": [0.0, -9.81]}))
    native_folder(foreign, Options(gravity=(0.0, -9.81)))
    for _ in range(2):  # from the cache too
        with pytest.raises(ConfigError, match=r"\[0.0, -1.0\] contradicts .*ramps/metadata.json.*\[0.0, -9.81\]"):
            native_folder(foreign, Options(gravity=(0.0, -1.0)))


def test_a_gravity_that_is_only_assumed_may_be_stated(tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    dmcf = pytest.importorskip("tests.data.convert.test_dmcf", reason="the extra `convert` is not installed")
    flow = dmcf.write(tmp_path / "flow" / "a.msgpack.zst", dmcf.frames()).parent
    assert read_metadata(native_folder(flow)).gravity == (0.0, -9.81, 0.0)
    assert read_metadata(native_folder(flow, Options(gravity=(0.0, -1.0, 0.0)))).gravity == (0.0, -1.0, 0.0)
