"""`nmpm inspect` gets through on data that `nmpm fit` and `nmpm convert` refuse."""

import json
from pathlib import Path

import numpy as np
import pytest

from nmpm.cli import main
from nmpm.data.format import write_split
from nmpm.data.generate import generate
from nmpm.data.inspection import inspect
from nmpm.data.inspection.reading import guess_family
from nmpm.data.loading.sources import FolderSource, StatedFacts
from nmpm.sim import load_preset
from tests.data.convert import records
from tests.data.convert.test_deepmind import METADATA, made
from tests.made_up import made_up_trajectory

KEYS = {"bounds": [[0.1, 0.9]] * 2, "dt": 0.0025, "dim": 2, "sequence_length": 12}


@pytest.fixture
def folder(tmp_path):
    write_split(tmp_path / "train.h5", [made_up_trajectory(12, 20, statics=3)] * 2)
    return tmp_path


def look(folder: Path, plain: object, **stated: object):
    (folder / "metadata.json").write_text(plain if isinstance(plain, str) else json.dumps(plain))
    return inspect(FolderSource(folder, StatedFacts(**stated)))


def test_the_family_is_guessed_where_nothing_states_it(folder):
    found = look(folder, KEYS)
    assert found.materials == {"goop": (20, 20), "boundary": (3, 3)}
    assert any("read as those of the deepmind family" in note for note in found.notes)
    assert not found.findings
    assert not any("read as those" in note for note in look(folder, KEYS, family="deepmind").notes)


@pytest.mark.parametrize(
    ("ids", "plain", "family"),
    [((5, 3), {}, "deepmind"), ((0, 1), {}, "lagrangebench"), ((0, 3), {}, "deepmind"),
     ((0, 3), {"periodic_boundary_conditions": []}, "lagrangebench"), ((99,), {}, "deepmind")],
)  # fmt: skip
def test_the_family_that_knows_most_ids_is_taken(ids, plain, family):
    assert guess_family(ids, plain) == family


def test_unknown_types_are_marked(folder):
    found = look(folder, KEYS | {"particle_types": {"3": "boundary"}})
    assert found.materials["type 7"] == (20, 20)
    assert any("Particle type 7 is not in the metadata" in finding for finding in found.findings)


@pytest.mark.parametrize(
    ("plain", "named"),
    [("{", "not valid JSON"), ("[]", "expected a JSON object"), ({}, "'dim' is missing"),
     (KEYS | {"dt": -1}, "dt = -1"), (KEYS | {"bounds": [[1, 0]] * 2}, "bounds ="), (KEYS | {"dim": 3}, "dim = 3"),
     (KEYS | {"particle_types": 7}, "particle_types = 7"), (KEYS | {"gravity": [1]}, "gravity ="),
     (KEYS | {"domain": [[0.5, 0.6]] * 2}, "domain")],
)  # fmt: skip
def test_wrong_metadata_become_findings(folder, plain, named):
    found = look(folder, plain)
    assert any(named in finding for finding in found.findings)
    assert found.splits["train"].frames == (12, 12)


def test_a_gravity_that_contradicts_the_metadata_is_a_finding(folder):
    found = look(folder, KEYS | {"gravity": [0, -9.81]}, gravity=(0.0, -1.0))
    assert any("contradicts" in finding for finding in found.findings)


def test_missing_metadata_and_a_damaged_split_become_findings(folder):
    (folder / "test.h5").write_text("nothing")
    found = inspect(FolderSource(folder))
    assert any("test.h5: cannot be read as HDF5" in finding for finding in found.findings)
    assert any("metadata.json: no such file" in finding for finding in found.findings)
    assert list(found.splits) == ["train"]


def test_foreign_data_that_convert_refuses_are_inspected(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    position, types = made()
    right, unknown = records.trajectory_record(position, types), records.trajectory_record(position, types * 0 + 9)
    damaged = records.trajectory_record(position * np.nan, types)
    records.write_records(tmp_path / "ramps" / "train.tfrecord", right, unknown, damaged)
    (tmp_path / "ramps" / "metadata.json").write_text(json.dumps(METADATA))
    assert main(["convert", str(tmp_path / "ramps"), str(tmp_path / "out")]) == 1
    assert main(["inspect", str(tmp_path / "ramps"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["splits"]["train"]["trajectories"] == 2
    assert any("Particle type 9 is not in the metadata" in finding for finding in found["findings"])
    assert any("record 2" in finding and "not read" in finding for finding in found["findings"])


@pytest.mark.parametrize("name", ["goop", "multimaterial", "wbcsph"])
def test_nothing_is_odd_about_simulated_data(name, tmp_path):
    preset = load_preset(name).with_frames(6)
    generate(preset, tmp_path / name, {"train": 1, "valid": 0, "test": 1}, seed=1, workers=1)
    found = inspect(FolderSource(tmp_path / name))
    assert found.findings == ()
