"""Without any connection: what the hub would give is put in place of it."""

import zipfile
from contextlib import suppress
from pathlib import Path

import huggingface_hub
import pytest
from huggingface_hub.errors import LocalEntryNotFoundError

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.hub import REPOSITORY, _unpack, hub_folder
from nmpm.errors import ConfigError, DataError
from tests.data.convert.test_neuralmpm import write


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    folder = tmp_path / "snapshot"
    (folder / "Goop").mkdir(parents=True)
    asked = []

    def download(repository, *, repo_type, allow_patterns):
        asked.append((repository, repo_type, allow_patterns))
        return str(folder)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    yield folder
    assert all(repo_type == "dataset" for _, repo_type, _ in asked)


def packed(folder: Path, archive: Path, prefix: str = "") -> None:
    with zipfile.ZipFile(archive, "w") as file:
        for path in sorted(folder.rglob("*.h5")):
            file.write(path, prefix + str(path.relative_to(folder)))


def test_archives_are_unpacked_and_trained_on(hub, tmp_path):
    for split in ("train", "valid", "test"):
        write(tmp_path / "made" / split / "sim_0.h5")
        packed(tmp_path / "made" / split, hub / "Goop" / f"{split}.zip", f"{split}/")
    assert sorted(path.name for path in hub_folder("Goop").iterdir()) == ["test", "train", "valid"]
    data = TrajectoryDataModule(name="Goop", source="hub", horizon=4, batch_size=1)
    data.prepare_data()
    data.setup("fit")
    assert data.scene.materials == ("goop",)
    assert next(iter(data.train_dataloader())).initial.position.shape[1] == 5


@pytest.mark.parametrize("name", ["/etc/x.h5", "a/../../x.h5"])
def test_archives_with_paths_outside_are_refused(hub, tmp_path, name):
    with zipfile.ZipFile(hub / "Goop" / "train.zip", "w") as file:
        file.writestr(name, b"x")
    with pytest.raises(DataError, match="does not unpack"):
        hub_folder("Goop")
    assert not list(tmp_path.rglob("x.h5"))


@pytest.mark.parametrize("place", [0, 28, 70, 119, 161])
def test_damaged_archives_are_named(hub, tmp_path, place):
    with zipfile.ZipFile(hub / "Goop" / "train.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("train/sim_0.json", bytes(range(256)))
    data = bytearray((hub / "Goop" / "train.zip").read_bytes())
    data[place] ^= 0x55
    (hub / "Goop" / "train.zip").write_bytes(data)
    with suppress(DataError):  # a damaged date does no harm
        hub_folder("Goop")


@pytest.mark.parametrize("name", ["", "../up", "a/b/c/d", "Goop;rm"])
def test_malformed_names_are_refused(name):
    with pytest.raises(ConfigError, match="is not the name of a dataset"):
        hub_folder(name)


def test_offline_error_gives_the_download_command(monkeypatch, tmp_path):
    def offline(*_, **__):
        raise LocalEntryNotFoundError("no connection")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", offline)
    with pytest.raises(DataError, match=f"{REPOSITORY}/WaterRamps: not in the cache.*hf download --repo-type dataset"):
        hub_folder("WaterRamps")


def test_an_archive_without_data_is_refused_and_leaves_nothing(tmp_path):
    source = tmp_path / "in"
    source.mkdir()
    with zipfile.ZipFile(source / "a.zip", "w") as archive:
        archive.writestr("readme.txt", "no data")
    with pytest.raises(DataError, match=r"cannot be unpacked \(no data files"):
        _unpack(source, [source / "a.zip"], tmp_path / "out")
    assert list(tmp_path.iterdir()) == [source]
