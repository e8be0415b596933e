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


@pytest.mark.parametrize(
    ("flag", "value"),
    [("--types", "water"), ("--static", "a"), ("--bounds", "1:0,0:1"), ("--gravity", "down"), ("--boundary", "open"),
     ("--family", "deepminds"), ("--dt", "-1")],
)  # fmt: skip
def test_values_that_cannot_be_are_named(foreign, tmp_path, capsys, flag, value):
    assert main(["convert", str(foreign), str(tmp_path / "out"), f"{flag}={value}"]) == 1
    assert value.strip("-") in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_help_lists_the_formats(capsys):
    with pytest.raises(SystemExit):
        main(["convert", "--help"])
    said = capsys.readouterr().out
    assert "deepmind" in said
    assert "native" in said
