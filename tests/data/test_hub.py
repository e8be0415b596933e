"""Without any connection: what the hub would give is put in place of it."""

import zipfile
from pathlib import Path

import huggingface_hub
import pytest
from huggingface_hub.errors import LocalEntryNotFoundError

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.sources import REPOSITORY, hub_folder
from nmpm.errors import ConfigError, DataError
from tests.data.convert.test_neuralmpm import write


@pytest.fixture
def hub(tmp_path, home, monkeypatch) -> Path:
    """What the hub gives of the dataset Goop."""
    folder = tmp_path / "snapshot" / "Goop"
    folder.mkdir(parents=True)

    def download(repository, *, repo_type, allow_patterns):
        assert (repository, repo_type) == (REPOSITORY, "dataset")
        return str(folder.parent)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    return folder


def archive(path: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)


def test_archives_are_unpacked_and_trained_on(hub, tmp_path):
    for split in ("train", "valid", "test"):
        path = tmp_path / "made" / "sim_0.h5"
        write(path)
        archive(hub / f"{split}.zip", {f"{split}/sim_0.h5": path.read_bytes()})
    assert sorted(path.name for path in hub_folder("Goop").iterdir()) == ["test", "train", "valid"]
    data = TrajectoryDataModule(name="Goop", source="hub", horizon=4, batch_size=1)
    data.prepare_data()
    data.setup("fit")
    assert data.scene.materials == ("goop",)
    assert next(iter(data.train_dataloader())).initial.position.shape[1] == 5


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("/etc/x.h5", "does not unpack"), ("a/../../x.h5", "does not unpack"), ("readme.txt", "no data files"),
        ("damaged.h5", "cannot be unpacked"),
    ],
)  # fmt: skip
def test_archives_that_are_damaged_or_lead_outside_are_refused_and_leave_nothing(hub, home, name, message):
    archive(hub / "train.zip", {name: b"x"})
    if name == "damaged.h5":
        (hub / "train.zip").write_bytes((hub / "train.zip").read_bytes()[:-30])
    with pytest.raises(DataError, match=message):
        hub_folder("Goop")
    assert not [path for path in home.parent.rglob("*") if path.is_file() and path.suffix in (".h5", ".txt")]


@pytest.mark.parametrize("name", ["", "../up", "Goop;rm"])
def test_malformed_names_are_refused(name):
    with pytest.raises(ConfigError, match="is not the name of a dataset"):
        hub_folder(name)


def test_offline_error_gives_the_download_command(monkeypatch):
    def offline(*_, **__):
        raise LocalEntryNotFoundError("no connection")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", offline)
    with pytest.raises(DataError, match=f"{REPOSITORY}/WaterRamps: not in the cache.*hf download --repo-type dataset"):
        hub_folder("WaterRamps")
