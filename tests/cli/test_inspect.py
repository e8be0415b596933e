import json
import re

import numpy as np
import pytest
from PIL import Image

from nmpm.cli import main
from nmpm.data.convert import native_folder
from nmpm.errors import DataError
from tests.data.convert import records
from tests.data.convert.records import METADATA, made


@pytest.fixture
def dataset(make_dataset):
    return make_dataset(train=((12, 40), (12, 50)), valid=(), test=((12, 45),), statics=4)


def test_one_screen_and_a_picture(dataset, tmp_path, capsys):
    assert main(["inspect", str(dataset), "--out", str(tmp_path / "look.png")]) == 0
    said = capsys.readouterr().out
    lines = said.splitlines()
    assert len(lines) <= 45
    assert max(len(line.replace(str(tmp_path), "")) for line in lines) <= 100
    assert "train     2 trajectories of 12 frames, 40-50 particles + 4 at rest" in said
    assert "<- recommended" in said
    assert "training here, 15 minutes" in said
    assert "nothing contradictory or odd found" in said
    with Image.open(tmp_path / "look.png") as picture:
        assert min(picture.size) > 200


def test_json_is_all_there_is_on_standard_output(dataset, tmp_path, capsys):
    assert main(["inspect", str(dataset), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["splits"]["train"]["particles"] == [40, 50]
    assert summary["costs"][str(summary["recommended"])]["steps"] > 0
    assert not list(tmp_path.glob("*.png"))


def test_one_split_stands_for_its_dataset(dataset, capsys):
    assert main(["inspect", str(dataset / "test.h5"), "--no-picture"]) == 0
    assert "train     2 trajectories" in capsys.readouterr().out


def test_types_that_the_files_do_not_name_can_be_named(dataset, capsys):
    assert main(["inspect", str(dataset), "--types", "7=honey", "--no-picture"]) == 0
    assert "honey (40-50)" in capsys.readouterr().out


def test_types_that_are_found_to_rest_do_so_under_the_names_that_a_user_states(tmp_path, capsys):
    rng = np.random.default_rng(0)
    position = rng.uniform(0, 1, (4, 1, 40, 2)) + 1e-3 * rng.normal(size=(4, 30, 40, 2)).cumsum(axis=1)
    position[:, :, 30:] = position[:1, :1, 30:]
    np.savez(tmp_path / "a.npz", position=position, types=np.repeat([0, 1], [30, 10]))
    assert main(["inspect", str(tmp_path / "a.npz"), "--types", "0=dust,1=grate", "--no-picture"]) == 0
    said = capsys.readouterr().out
    assert "30 particles + 10 at rest" in said
    assert "nothing contradictory or odd found" in said


def test_a_cache_that_cannot_be_written_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "file"))
    records.write_records(tmp_path / "ramps" / "train.tfrecord", records.trajectory_record(*made()))
    (tmp_path / "ramps" / "metadata.json").write_text(json.dumps(METADATA))
    assert main(["inspect", str(tmp_path / "ramps"), "--json"]) == 0
    assert re.search(
        r"file.*: cannot be written \(.*NMPM_HOME", json.loads(capsys.readouterr().out)["findings"][0]["sentence"]
    )
    with pytest.raises(DataError, match="NMPM_HOME"):
        native_folder(tmp_path / "ramps")


def test_a_gravity_that_contradicts_foreign_data_is_a_finding(tmp_path, capsys):
    folder = tmp_path / "ramps"
    for split in ("train", "valid", "test"):
        records.write_records(folder / f"{split}.tfrecord", records.trajectory_record(*made(frames=8)))
    (folder / "metadata.json").write_text(json.dumps(METADATA | {"gravity": [0.0, -9.81]}))
    assert main(["inspect", str(folder), "--no-picture", "--gravity=0,-1"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "gravity = [0.0, -1.0] contradicts" in said
    assert "which states gravity [0.0, -9.81]" in said
