import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from nmpm.data.format import Split, read_metadata
from nmpm.data.generate import generate
from nmpm.data.simulation import SimulationRequest, seed_of_draw
from nmpm.errors import ConfigError, DataError, UnstableError
from nmpm.sim import MpmPreset
from tests.data.tiny_goop import COUNTS, GOOP, TINY, fingerprints

SIMULATE = """
import json, sys
from pathlib import Path
from nmpm.data.generate import generate
from nmpm.sim import preset_from_dict
generate(preset_from_dict(json.loads(sys.argv[1])), Path(sys.argv[2]), json.loads(sys.argv[3]), seed=5, workers=2)
"""


def start_simulation(folder: Path, counts: dict[str, int]) -> subprocess.Popen[bytes]:
    arguments = [json.dumps(TINY.to_dict()), str(folder), json.dumps(counts)]
    return subprocess.Popen([sys.executable, "-c", SIMULATE, *arguments], stderr=subprocess.DEVNULL)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("goop")
    generate(TINY, folder, COUNTS, seed=5, workers=1)
    return folder


def test_contains_the_simulated_trajectories_in_order(made):
    for split, count in COUNTS.items():
        assert len(Split(made / f"{split}.h5")) == count
    read = Split(made / "valid.h5").read(0)
    again = TINY.simulate(int(read.attributes["seed"]))
    np.testing.assert_array_equal(read.position, again.position)
    np.testing.assert_array_equal(read.particle_type, again.particle_type)


def test_metadata_states_the_facts_and_the_source(made):
    metadata = read_metadata(made)
    assert (metadata.bounds, metadata.dt, metadata.dim) == (GOOP.box, GOOP.frame_dt, 2)
    assert metadata.sequence_length == 30
    assert metadata.particle_types == {7: "goop"}
    assert metadata.gravity == (0.0, -9.81)
    assert metadata.domain == GOOP.domain
    assert "nmpm" in metadata.extra["generator"]
    assert "Simulated by nmpm" in metadata.extra["note"]
    assert metadata.extra["simulation"]["seed"] == 5
    assert metadata.extra["simulation"]["counts"] == COUNTS


def test_metadata_has_the_statistics_of_the_training_split(made):
    split = Split(made / "train.h5")
    runs = [split.read(index).position.astype(np.float64) for index in range(len(split))]
    extra = read_metadata(made).extra
    for key, order in (("vel", 1), ("acc", 2)):
        values = np.concatenate([np.diff(run, n=order, axis=0).reshape(-1, 2) for run in runs])
        np.testing.assert_allclose(extra[f"{key}_mean"], values.mean(0), rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(extra[f"{key}_std"], values.std(0), rtol=1e-9)


def test_a_dataset_grows_from_a_smaller_one_by_the_same_bytes(made, tmp_path, monkeypatch):
    counts = {"train": 6, "valid": 0, "test": 1}
    generate(TINY, tmp_path / "whole", counts, seed=5)
    simulated: list[int] = []
    simulate = MpmPreset.simulate
    monkeypatch.setattr(MpmPreset, "simulate", lambda *all_: simulated.append(all_[1]) or simulate(*all_))
    generate(TINY, tmp_path / "grown", counts, seed=5, copy_from=made)
    assert len(simulated) == 2
    assert fingerprints(tmp_path / "grown") == fingerprints(tmp_path / "whole")


def test_a_complete_dataset_is_not_rewritten(made):
    before = {path: path.stat().st_mtime_ns for path in made.iterdir()}
    generate(TINY, made, COUNTS, seed=5)
    assert {path: path.stat().st_mtime_ns for path in made.iterdir()} == before


def test_a_killed_simulation_resumes_with_the_same_bytes(tmp_path):
    counts = {"train": 30, "valid": 1, "test": 1}
    killed = tmp_path / "killed"
    process = start_simulation(killed, counts)
    deadline = time.monotonic() + 60
    while len(list(killed.glob(".parts/*.npz"))) < 3 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(timeout=60)
    (killed / ".train.h5.99999.part").write_bytes(b"half a file")
    finished = {path.name: path.stat().st_mtime_ns for path in killed.glob(".parts/*.npz")}
    assert 3 <= len(finished) < 30
    assert not (killed / "metadata.json").exists()

    generate(TINY, killed, counts, seed=5)
    generate(TINY, tmp_path / "whole", counts, seed=5)
    assert fingerprints(killed) == fingerprints(tmp_path / "whole")


def interrupted(folder: Path, monkeypatch, seed: int = 0) -> None:
    """Leaves a folder as an interruption after the fourth trajectory does."""
    simulated: list[int] = []
    simulate = MpmPreset.simulate

    def stops_at_the_fifth(preset, trajectory_seed, *progress):
        if len(simulated) == 4:
            raise KeyboardInterrupt
        simulated.append(trajectory_seed)
        return simulate(preset, trajectory_seed, *progress)

    with monkeypatch.context() as patch:
        patch.setattr(MpmPreset, "simulate", stops_at_the_fifth)
        with pytest.raises(KeyboardInterrupt):
            generate(TINY, folder, COUNTS, seed, workers=1)


def test_resumes_with_the_existing_parts(tmp_path, monkeypatch):
    interrupted(tmp_path, monkeypatch)
    assert len(list(tmp_path.glob(".parts/*.npz"))) == 4
    simulated: list[int] = []
    simulate = MpmPreset.simulate
    monkeypatch.setattr(MpmPreset, "simulate", lambda preset, seed, _: simulated.append(seed) or simulate(preset, seed))
    generate(TINY, tmp_path, COUNTS, workers=1)
    assert len(simulated) == 3


UNSTABLE = {
    SimulationRequest(TINY, COUNTS, 5).entropy("train", 1): 1,
    SimulationRequest(TINY, COUNTS, 5).entropy("test", 0): 2,
}
"""How many of a trajectory's first seeds blow up."""


@pytest.fixture
def unstable(monkeypatch) -> None:
    """Some seeds blow up in frame 20."""
    bad = {seed_of_draw(place, draw) for place, count in UNSTABLE.items() for draw in range(count)}
    simulate = MpmPreset.simulate

    def blows_up(preset, seed, *progress):
        if seed in bad and preset.frames >= 20:
            raise UnstableError(f"seed {seed}: blown up in frame 20")
        return simulate(preset, seed, *progress)

    monkeypatch.setattr(MpmPreset, "simulate", blows_up)


@pytest.mark.usefixtures("unstable")
def test_another_seed_takes_the_place_of_an_unstable_one(made, tmp_path, caplog):
    generate(TINY, tmp_path, COUNTS, seed=5)
    simulation = read_metadata(tmp_path).extra["simulation"]
    assert simulation["redrawn"] == {"train": {"1": 1}, "test": {"0": 2}}
    assert caplog.text.count("blown up in frame 20") == 3

    train, test = (Split(tmp_path / f"{split}.h5") for split in ("train", "test"))
    request = SimulationRequest(TINY, COUNTS, 5, simulation["redrawn"])
    assert test.attributes(0)["seed"] == request.trajectory_seed("test", 0)
    for index in (0, 2, 3):  # the others are what they were
        np.testing.assert_array_equal(train.read(index).position, Split(made / "train.h5").read(index).position)
    assert train.attributes(1)["seed"] == request.trajectory_seed("train", 1)
    generate(TINY, tmp_path, COUNTS, seed=5)  # the same data as requested


def test_a_full_disk_is_an_error_and_the_next_call_continues(made, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(DataError, match="No space left") as caught:
            generate(TINY, tmp_path, COUNTS, seed=5)
    assert str(tmp_path) in str(caught.value)
    assert not list(tmp_path.glob("*.h5"))
    generate(TINY, tmp_path, COUNTS, seed=5)
    assert fingerprints(tmp_path) == fingerprints(made)


@pytest.mark.parametrize(
    ("preset", "counts", "seed", "message"),
    [
        (TINY, {**COUNTS, "train": 5}, 5, "counts.train is 4, requested 5"),
        (dataclasses.replace(TINY, frames=31), COUNTS, 5, "preset.frames is 30, requested 31"),
    ],
)
def test_a_folder_with_other_data_is_refused(made, preset, counts, seed, message):
    with pytest.raises(DataError, match=f"{message}.*[Cc]hoose another folder, or delete"):
        generate(preset, made, counts, seed)


def test_foreign_files_are_not_overwritten(tmp_path):
    (tmp_path / "train.h5").write_bytes(b"precious")
    with pytest.raises(DataError, match=r"train\.h5"):
        generate(TINY, tmp_path, COUNTS)
    assert (tmp_path / "train.h5").read_bytes() == b"precious"


def test_a_damaged_part_is_named(tmp_path, monkeypatch):
    interrupted(tmp_path, monkeypatch)
    part = tmp_path / ".parts" / "train-00002.npz"
    part.write_bytes(part.read_bytes()[:100])
    with pytest.raises(DataError, match=r"train-00002.npz: damaged.*delete"):
        generate(TINY, tmp_path, COUNTS)
    assert not (tmp_path / "train.h5").exists()


NONE = dict.fromkeys(COUNTS, 0)


IMPOSSIBLE = ({"train": 1}, {**COUNTS, "test": -1}, NONE, {**COUNTS, "test": 1.5}, "{train:3}")


@pytest.mark.parametrize("counts", IMPOSSIBLE)
def test_invalid_counts_are_refused(tmp_path, counts):
    with pytest.raises(ConfigError, match="train, valid, test"):
        generate(TINY, tmp_path, counts)
