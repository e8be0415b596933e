import dataclasses
import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm.cli import main
from nmpm.data.convert import Options
from nmpm.data.findings import Finding, Severity
from nmpm.data.format import Trajectory, write_metadata, write_split
from nmpm.data.inspection import Inspection, inspect
from nmpm.data.simulation import generate
from nmpm.data.sources import FolderSource
from nmpm.errors import DataError
from nmpm.sim import load_preset
from tests.data.convert import records
from tests.data.convert.records import METADATA, made
from tests.made_up import made_up_metadata, made_up_trajectory

UNIT = {"bounds": ((0.0, 1.0),) * 2, "domain": ((0.0, 1.0),) * 2, "particle_volume": 1e-4}
KEYS = {"bounds": [[0.1, 0.9]] * 2, "dt": 0.0025, "dim": 2, "sequence_length": 12}


def look(folder: Path, *trajectories: Trajectory, **changes: object) -> Inspection:
    """Written and inspected; without the metadata's remarks about their number of frames."""
    write_split(folder / "train.h5", trajectories)
    length = len(trajectories[0].position)
    write_metadata(folder, made_up_metadata(**({"sequence_length": length} | changes)))
    return inspect(FolderSource(folder))


def odd(found: Inspection) -> list[Finding]:
    """The findings that are not mere notes."""
    return [finding for finding in found.findings if finding.severity != Severity.NOTE]


def lattice(side: int, frames: int = 5, shift: tuple[float, float] = (0.0, 0.0)) -> Trajectory:
    """side² particles evenly over the unit square, moving together by `shift` per frame."""
    axis = (np.arange(side) + 0.5) / side
    start = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(1, -1, 2)
    position = start + np.arange(frames)[:, None, None] * np.array(shift)
    return Trajectory(position.astype(np.float32), np.full(side**2, 7))


def test_particles_per_cell_of_a_lattice_are_counted_exactly(tmp_path):
    found = look(tmp_path, lattice(64), **UNIT)
    per_cell = {grid.cells: grid.per_cell for grid in found.grids}
    assert per_cell == {number: 64**2 / number**2 for number in (16, 24, 32, 40, 48, 56)} | {72: 1, 80: 1}
    assert found.recommended == 32
    assert found.spacing == pytest.approx(1 / 64, rel=1e-5)
    assert found.occupied == found.occupied_each == 1.0


def test_speeds_are_in_cells_per_frame(tmp_path):
    run = lattice(4, 6, (0.6 * 0.01, -0.8 * 0.01))
    for grid in look(tmp_path, run, **(UNIT | {"domain": ((-1.0, 2.0),) * 2})).grids:
        assert grid.most_speed == pytest.approx(0.01 * grid.cells / 3, rel=1e-2)
        assert grid.median_speed == pytest.approx(grid.most_speed, rel=0.03)


def test_time_of_rest_is_the_end_of_the_last_motion(tmp_path):
    position = np.repeat(lattice(3).position[:1], 20, axis=0)
    position[:8, :, 1] += 0.01 * (7 - np.arange(8, dtype=np.float32))[:, None]
    found = look(tmp_path, Trajectory(position, np.full(9, 7)), lattice(3, 20, (0.001, 0.0)), **UNIT)
    assert found.rest == (7, 7, 7)
    assert found.restless == 1


def test_first_acceleration_in_free_fall_is_gravity(tmp_path):
    run = lattice(4, 6)
    run.position[..., 1] += 0.5 * -9.81 * (0.0025 * np.arange(6))[:, None] ** 2
    found = look(tmp_path, run, **(UNIT | {"gravity": None, "domain": ((-1.0, 2.0),) * 2}))
    assert found.gravity is None
    assert found.first_acceleration == pytest.approx((0.0, -9.81), abs=0.05)


def test_what_varies(tmp_path):
    first, second = made_up_trajectory(12, 5), made_up_trajectory(14, 6, seed=1, statics=2)
    first.attributes["gravity"], second.attributes["gravity"] = [0.0, -1.0], [1.0, 0.0]
    found = look(tmp_path, first, second)
    assert found.varies == ("gravity", "materials", "particles", "frames", "obstacles")
    train = found.splits["train"]
    assert (train.frames, train.particles, train.static) == ((12, 14), (5, 6), (0, 2))
    same = made_up_trajectory(12, 30, statics=3)
    same.attributes["gravity"] = np.array([0.0, -9.81], np.float32)  # no other gravity than the metadata's
    found = look(tmp_path / "same", same, made_up_trajectory(12, 30, statics=3, seed=1))
    assert (found.varies, odd(found), found.notes) == ((), [], ())


def test_anomalies_of_positions(tmp_path):
    run = made_up_trajectory(12, 30, statics=2)
    run.position[7:, 11, 0] += 0.5
    run.position[:, 4] = run.position[:, 20]
    run.position[:, 31, 1] += np.linspace(0, 0.05, 12, dtype=np.float32)
    wall, twin, jump = odd(look(tmp_path, run))
    assert (jump.kind, jump.where, jump.details) == ("jumps", "train 00000", "frame 7, particle 11")
    assert (twin.kind, twin.details) == ("overlapping particles", "frame 0, particle 4")
    assert (wall.kind, wall.details) == ("moving walls", "particle 31")


def test_statements_that_disagree_with_the_trajectories(tmp_path):
    run = made_up_trajectory(12, 30, statics=2)
    found = look(tmp_path, run, extra={"vel_std": [1.0, 1.0]}, sequence_length=5)
    statements = [finding.sentence for finding in found.findings if finding.kind in ("statistics", "sequence length")]
    assert "state vel_std = (1, 1)" in statements[0]
    assert "sequence_length 5; trajectories have 12 frames" in statements[1]
    found = look(tmp_path, run, domain=((0.45, 0.92), (0.08, 0.92)), bounds=((0.5, 0.9), (0.1, 0.9)))
    assert any("is outside of the stated domain" in finding.sentence for finding in found.findings)
    found = look(tmp_path, dataclasses.replace(run, particle_type=np.where(run.particle_type == 3, 42, 7)))
    assert found.findings[0].sentence.startswith("Particle type 42 is not in the metadata")
    assert found.materials["type 42"] == (2, 2)


def test_damaged_trajectories_are_left_out(tmp_path):
    write_split(tmp_path / "train.h5", [made_up_trajectory(12, 8, seed=i) for i in range(10)])
    write_metadata(tmp_path, made_up_metadata())
    with h5py.File(tmp_path / "train.h5", "a") as file:
        file["00004"]["position"][3, 2, 1] = np.nan
    found = inspect(FolderSource(tmp_path), trajectories=3)
    assert any("trajectory 00004: position of particle 2 in frame 3" in finding.sentence for finding in found.findings)
    assert (found.splits["train"].trajectories, found.splits["train"].inspected) == (10, 3)
    assert found.grids[0].per_cell > 0  # the others were looked at
    with h5py.File(tmp_path / "train.h5", "a") as file:
        for name in file:
            file[name]["position"][0] = np.inf
    with pytest.raises(DataError, match="none of its trajectories could be read"):
        inspect(FolderSource(tmp_path))


@pytest.fixture
def folder(tmp_path):
    write_split(tmp_path / "train.h5", [made_up_trajectory(12, 20, statics=3, seed=seed) for seed in range(2)])
    return tmp_path


def look_at(folder: Path, plain: object, **stated: object) -> Inspection:
    (folder / "metadata.json").write_text(plain if isinstance(plain, str) else json.dumps(plain))
    return inspect(FolderSource(folder, Options(**stated)))


def test_the_family_is_guessed_where_nothing_states_it(folder):
    found = look_at(folder, KEYS)
    assert found.materials == {"goop": (20, 20), "boundary": (3, 3)}
    assert any("read as those of the deepmind family" in note for note in found.notes)
    assert not odd(found)
    assert not any("read as those" in note for note in look_at(folder, KEYS, family="deepmind").notes)


@pytest.mark.parametrize(
    ("plain", "named"),
    [
        ("{", ["not valid JSON"]), ({}, ["'dim' is missing"]), (KEYS | {"dim": 3}, ["dim = 3"]),
        (KEYS | {"domain": [[0.5, 0.6]] * 2}, ["domain"]),
        (KEYS | {"dt": -1, "gravity": [1], "particle_types": 7}, ["dt = -1", "gravity = [1]", "particle_types = 7"]),
    ],
)  # fmt: skip
def test_wrong_metadata_become_findings_all_at_once(folder, plain, named):
    found = look_at(folder, plain)
    assert all(any(words in finding.sentence for finding in found.findings) for words in named)
    assert found.splits["train"].frames == (12, 12)


def test_missing_metadata_and_a_damaged_split_become_findings(folder):
    (folder / "test.h5").write_text("nothing")
    found = inspect(FolderSource(folder))
    assert any("test.h5: cannot be read as HDF5" in finding.sentence for finding in found.findings)
    assert any("metadata.json: no such file" in finding.sentence for finding in found.findings)
    assert list(found.splits) == ["train"]
    found = look_at(folder, KEYS | {"gravity": [0, -9.81]}, gravity=(0.0, -1.0))
    assert any("contradicts" in finding.sentence for finding in found.findings)
    assert found.gravity == (0.0, -9.81)


@pytest.mark.usefixtures("home")
def test_foreign_data_that_convert_refuses_are_inspected(tmp_path, capsys):
    position, types = made()
    right, unknown = records.trajectory_record(position, types), records.trajectory_record(position, types * 0 + 9)
    damaged = records.trajectory_record(position * np.inf, types)
    records.write_records(tmp_path / "ramps" / "train.tfrecord", right, unknown, damaged)
    (tmp_path / "ramps" / "metadata.json").write_text(json.dumps(METADATA))
    assert main(["convert", str(tmp_path / "ramps"), str(tmp_path / "out")]) == 1
    assert main(["inspect", str(tmp_path / "ramps"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["splits"]["train"]["trajectories"] == 2
    assert any("Particle type 9 is not in the metadata" in finding["sentence"] for finding in found["findings"])
    assert any("record 2" in finding["sentence"] and "not read" in finding["sentence"] for finding in found["findings"])


@pytest.mark.parametrize(
    "name", ["goop", *(pytest.param(name, marks=pytest.mark.slow) for name in ("multimaterial", "wbcsph"))]
)
def test_nothing_is_odd_about_simulated_data(name, tmp_path):
    generate(load_preset(name).with_frames(4), tmp_path / name, {"train": 1, "valid": 0, "test": 1}, seed=1, workers=1)
    assert odd(inspect(FolderSource(tmp_path / name))) == []


@pytest.mark.slow
def test_recorded_channel_wraps(recorded):
    stated = Options("jax-sph", boundary=("periodic", "wall"))
    found = inspect(FolderSource(recorded / "jaxsph-heated-channel-2d", stated), trajectories=1)
    assert found.fields == {"temperature": (130, 950)}
    assert not any("jumps" in finding.sentence for finding in found.findings)
    assert found.grids[0].most_speed < 2  # and not the box's length, as across the period
