import os

import numpy as np
import pytest

from nmpm.data.convert import Options, native_folder
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.format import read_metadata
from nmpm.data.sources import FolderSource
from nmpm.errors import ConfigError
from tests.data.convert import records

pytestmark = pytest.mark.usefixtures("home")


@pytest.fixture
def foreign(tmp_path):
    return records.write_dataset(tmp_path / "ramps")


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
    assert data.scene.obstacles
    assert data.scene.gravity == (0.0, -9.81)
    frames = next(iter(data.train_dataloader())).initial.position[0].numpy()
    rows = [records.made(seed=seed)[0][first, :3] for seed in range(2) for first in range(8)]
    assert any(np.allclose(frames, row, atol=1e-7) for row in rows)


def test_a_gravity_that_contradicts_a_foreign_format_is_refused(foreign):
    records.write_dataset(foreign, gravity=[0.0, -9.81])
    native_folder(foreign, Options(gravity=(0.0, -9.81)))
    for _ in range(2):  # from the cache too
        with pytest.raises(ConfigError, match=r"\[0.0, -1.0\] contradicts .*ramps/metadata.json.*\[0.0, -9.81\]"):
            native_folder(foreign, Options(gravity=(0.0, -1.0)))


def test_a_gravity_that_is_only_assumed_may_be_stated(tmp_path):
    dmcf = pytest.importorskip("tests.data.convert.test_dmcf", reason="the extra `convert` is not installed")
    flow = dmcf.write(tmp_path / "flow" / "a.msgpack.zst", dmcf.frames()).parent
    assert read_metadata(native_folder(flow)).gravity == (0.0, -9.81, 0.0)
    assert read_metadata(native_folder(flow, Options(gravity=(0.0, -1.0, 0.0)))).gravity == (0.0, -1.0, 0.0)


def test_types_that_are_found_to_rest_do_so_under_the_names_that_a_user_states(tmp_path):
    rng = np.random.default_rng(0)
    position = rng.uniform(0, 1, (4, 1, 40, 2)) + 1e-3 * rng.normal(size=(4, 30, 40, 2)).cumsum(axis=1)
    position[:, :, 30:] = position[:1, :1, 30:]
    np.savez(tmp_path / "a.npz", position=position, types=np.repeat([0, 1], [30, 10]))
    data = TrajectoryDataModule(path=str(tmp_path / "a.npz"))
    assert data.data_source.metadata.static_types == {1}
    source = FolderSource(tmp_path / "a.npz", Options(types={0: "dust", 1: "grate"}))
    assert source.metadata.static_types == {1}
    assert (source.scene.materials, source.scene.obstacles) == (("dust",), True)
