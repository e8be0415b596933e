import json

import pytest

from nmpm.cli import main
from nmpm.data.format import read_metadata
from tests.data.convert import records
from tests.data.convert.records import METADATA, made


@pytest.fixture
def foreign(tmp_path):
    records.write_records(tmp_path / "ramps" / "train.tfrecord", records.trajectory_record(*made()))
    (tmp_path / "ramps" / "metadata.json").write_text(json.dumps(METADATA))
    return tmp_path / "ramps"


def test_converts_and_says_what_it_took(foreign, tmp_path, capsys):
    assert main(["convert", str(foreign), str(tmp_path / "out"), "--gravity", "0,-9.81", "--types", "5=oil"]) == 0
    said = capsys.readouterr().out
    assert "- Particle types have the meaning of the deepmind family." in said
    assert f"nmpm inspect {tmp_path / 'out'}" in said
    metadata = read_metadata(tmp_path / "out")
    assert metadata.gravity == (0.0, -9.81)
    assert metadata.particle_types[5] == "oil"
    assert main(["convert", str(foreign), str(tmp_path / "new"), "--boundary=open"]) == 1
    assert "boundary = ['open'] needs one entry for each" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_help_lists_the_formats(capsys):
    with pytest.raises(SystemExit):
        main(["convert", "--help"])
    said = capsys.readouterr().out
    assert "deepmind" in said
    assert "native" in said
