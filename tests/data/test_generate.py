"""Datasets that are simulated: content, resumption to the byte, refusals, and shards as the tasks of a job array."""

import dataclasses
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from nmpm.cli import main
from nmpm.data.format import Split, read_metadata
from nmpm.data.simulation import Shard, SimulationRequest, generate, seed_of_draw
from nmpm.errors import ConfigError, DataError, UnstableError
from nmpm.sim import MpmPreset
from tests.data.tiny_goop import COUNTS, GOOP, TINY, fingerprints

SIMULATE = """
import json, sys
from pathlib import Path
from nmpm.data.simulation import Shard, generate
from nmpm.sim import preset_from_dict
preset, folder, counts, shard = sys.argv[1:]
preset = preset_from_dict(json.loads(preset))
print(generate(preset, Path(folder), json.loads(counts), seed=5, shard=Shard.parse(shard)))
"""


def start_shard(folder: Path, shard: str, counts: dict[str, int] = COUNTS) -> subprocess.Popen[bytes]:
    words = [sys.executable, "-c", SIMULATE, json.dumps(TINY.to_dict()), str(folder), json.dumps(counts), shard]
    return subprocess.Popen(words, stdout=subprocess.PIPE)


def run_shard(folder: Path, shard: str, seed: int = 5) -> int:
    return generate(TINY, folder, COUNTS, seed, workers=1, shard=Shard.parse(shard))


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("goop")
    generate(TINY, folder, COUNTS, seed=5, workers=1)
    return folder


def test_contains_the_simulated_trajectories_in_order_and_is_not_rewritten(made):
    before = {path: path.stat().st_mtime_ns for path in made.iterdir()}
    generate(TINY, made, COUNTS, seed=5)
    assert {path: path.stat().st_mtime_ns for path in made.iterdir()} == before
    for split, count in COUNTS.items():
        assert len(Split(made / f"{split}.h5")) == count
    read = Split(made / "valid.h5").read(0)
    again = TINY.simulate(int(read.attributes["seed"]))
    np.testing.assert_array_equal(read.position, again.position)
    np.testing.assert_array_equal(read.particle_type, again.particle_type)


def test_metadata_state_the_facts_the_source_and_the_statistics_of_the_training_split(made):
    metadata = read_metadata(made)
    assert (metadata.bounds, metadata.dt, metadata.dim) == (GOOP.box, GOOP.frame_dt, 2)
    assert (metadata.domain, metadata.gravity) == (GOOP.domain, (0.0, -9.81))
    assert (metadata.sequence_length, metadata.particle_types) == (20, {7: "goop"})
    assert "nmpm" in metadata.extra["generator"]
    assert "Simulated by nmpm" in metadata.extra["note"]
    assert metadata.extra["simulation"]["seed"] == 5
    assert metadata.extra["simulation"]["counts"] == COUNTS
    split = Split(made / "train.h5")
    steps = [np.diff(split.read(index).position.astype(np.float64), axis=0).reshape(-1, 2) for index in range(4)]
    np.testing.assert_allclose(metadata.extra["vel_std"], np.concatenate(steps).std(0), rtol=1e-9)


def test_a_dataset_grows_from_a_smaller_one_by_the_same_bytes(made, tmp_path, simulated_seeds):
    counts = {"train": 6, "valid": 0, "test": 1}
    generate(TINY, tmp_path / "grown", counts, seed=5, workers=1, copy_from=made)
    assert len(simulated_seeds) == 2
    generate(TINY, tmp_path / "whole", counts, seed=5, workers=1)
    assert fingerprints(tmp_path / "grown") == fingerprints(tmp_path / "whole")


def test_a_killed_simulation_resumes_with_the_same_bytes(tmp_path):
    counts = {"train": 30, "valid": 1, "test": 1}
    killed = tmp_path / "killed"
    process = start_shard(killed, "1/1", counts)
    deadline = time.monotonic() + 60
    while len(list(killed.glob(".parts/*.npz"))) < 3 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(timeout=60)
    (killed / ".train.h5.99999.part").write_bytes(b"half a file")
    assert 3 <= len(list(killed.glob(".parts/*.npz"))) < 30
    assert not (killed / "metadata.json").exists()
    for folder in (killed, tmp_path / "whole"):
        generate(TINY, folder, counts, seed=5, workers=1)
    assert fingerprints(killed) == fingerprints(tmp_path / "whole")


@pytest.fixture
def interrupted(tmp_path, monkeypatch) -> Path:
    """A folder as an interruption after the fourth trajectory leaves it."""
    number, simulate = iter(range(10)), MpmPreset.simulate

    def stops_at_the_fifth(*all_):
        if next(number) == 4:
            raise KeyboardInterrupt
        return simulate(*all_)

    with monkeypatch.context() as patch:
        patch.setattr(MpmPreset, "simulate", stops_at_the_fifth)
        with pytest.raises(KeyboardInterrupt):
            generate(TINY, tmp_path, COUNTS, 5, workers=1)
    return tmp_path


def test_an_interrupted_simulation_resumes_with_the_existing_parts(made, interrupted, simulated_seeds):
    assert len(list(interrupted.glob(".parts/*.npz"))) == 4
    part = interrupted / ".parts" / "train-00002.npz"
    whole = part.read_bytes()
    part.write_bytes(whole[:100])
    with pytest.raises(DataError, match=r"train-00002.npz: damaged.*delete"):
        generate(TINY, interrupted, COUNTS, 5, workers=1)
    assert not (interrupted / "train.h5").exists()
    part.write_bytes(whole)
    generate(TINY, interrupted, COUNTS, 5, workers=1)
    assert len(simulated_seeds) == 3
    assert fingerprints(interrupted) == fingerprints(made)


def test_another_seed_takes_the_place_of_an_unstable_one(made, tmp_path, caplog, monkeypatch):
    request, simulate = SimulationRequest(TINY, COUNTS, 5), MpmPreset.simulate
    unstable = {
        seed_of_draw(request.entropy(split, index), draw)
        for split, index, draws in (("train", 1, 1), ("test", 0, 2))
        for draw in range(draws)
    }

    def blows_up(preset, seed, *progress):
        if seed in unstable:
            raise UnstableError(f"seed {seed}: blown up in frame 20")
        return simulate(preset, seed, *progress)

    monkeypatch.setattr(MpmPreset, "simulate", blows_up)
    generate(TINY, tmp_path, COUNTS, seed=5, workers=1)
    simulation = read_metadata(tmp_path).extra["simulation"]
    assert simulation["redrawn"] == {"train": {"1": 1}, "test": {"0": 2}}
    assert caplog.text.count("blown up in frame 20") == 3
    request = SimulationRequest(TINY, COUNTS, 5, simulation["redrawn"])
    train, test = (Split(tmp_path / f"{split}.h5") for split in ("train", "test"))
    assert test.attributes(0)["seed"] == request.trajectory_seed("test", 0)
    assert train.attributes(1)["seed"] == request.trajectory_seed("train", 1)
    for index in (0, 2, 3):  # the others are what they were
        np.testing.assert_array_equal(train.read(index).position, Split(made / "train.h5").read(index).position)
    generate(TINY, tmp_path, COUNTS, seed=5)  # the same data as requested


def test_a_full_disk_is_an_error_and_the_next_call_continues(made, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(DataError, match=f"{tmp_path}.*No space left"):
            generate(TINY, tmp_path, COUNTS, seed=5, workers=1)
    assert not list(tmp_path.glob("*.h5"))
    generate(TINY, tmp_path, COUNTS, seed=5, workers=1)
    assert fingerprints(tmp_path) == fingerprints(made)


@pytest.mark.parametrize(
    ("change", "counts", "message"),
    [
        ({}, {**COUNTS, "train": 5}, "counts.train is 4, requested 5"),
        ({"frames": 31}, COUNTS, "preset.frames is 20, requested 31"),
    ],
)
def test_a_folder_with_other_data_is_refused(made, change, counts, message):
    with pytest.raises(DataError, match=f"{message}.*[Cc]hoose another folder, or delete"):
        generate(dataclasses.replace(TINY, **change), made, counts, 5)


def test_foreign_files_are_not_overwritten(tmp_path):
    (tmp_path / "train.h5").write_bytes(b"precious")
    with pytest.raises(DataError, match=r"train\.h5"):
        generate(TINY, tmp_path, COUNTS)
    assert (tmp_path / "train.h5").read_bytes() == b"precious"


@pytest.mark.parametrize(
    "counts",
    [{"train": 1}, {**COUNTS, "test": -1}, dict.fromkeys(COUNTS, 0), {**COUNTS, "test": 1.5}, "{train:3}"],
)
def test_invalid_counts_are_refused(tmp_path, counts):
    with pytest.raises(ConfigError, match="train, valid, test"):
        generate(TINY, tmp_path, counts)


class TestShards:
    def test_the_last_one_completes_the_bytes_of_one_process(self, made, tmp_path):
        assert run_shard(tmp_path, "2/2") == 4
        assert not list(tmp_path.glob("*.h5"))
        assert run_shard(tmp_path, "1/2") == 0
        assert fingerprints(tmp_path) == fingerprints(made)
        assert run_shard(tmp_path, "2/3") == 0  # complete: nothing is done
        assert not (tmp_path / ".parts").exists()

    def test_at_the_same_time_they_give_the_same_bytes(self, made, tmp_path):
        processes = [start_shard(tmp_path, shard) for shard in ("1/2", "2/2")]
        assert 0 in [int(process.communicate(timeout=120)[0]) for process in processes]
        assert fingerprints(tmp_path) == fingerprints(made)

    def test_parts_that_were_copied_together_are_merged(self, made, tmp_path):
        for shard, name in (("1/2", "a"), ("2/2", "b")):
            run_shard(tmp_path / name, shard)
        shutil.copytree(tmp_path / "a" / ".parts", tmp_path / "b" / ".parts", dirs_exist_ok=True)
        generate(TINY, tmp_path / "b", COUNTS, seed=5, workers=1)
        assert fingerprints(tmp_path / "b") == fingerprints(made)

    def test_wrong_ones_and_those_of_other_datasets_are_refused(self, tmp_path):
        run_shard(tmp_path, "1/2", seed=1)
        with pytest.raises(DataError, match="seed is 1, requested 2"):
            run_shard(tmp_path, "2/2", seed=2)
        for text in ("0/4", "5/4", "1", "a/b", "²/4"):
            with pytest.raises(ConfigError, match="as in 1/8, 2/8"):
                Shard.parse(text)

    def test_the_command_says_what_is_missing(self, tmp_path, capsys):
        words = ["simulate", "goop", "--train", "2", "--valid", "1", "--test", "0", "--frames", "2", "--workers", "1"]
        words += ["--out", str(tmp_path / "goop")]
        assert main([*words, "--shard", "1/2"]) == 0
        said = capsys.readouterr().out
        assert "shard 1/2 is in" in said
        assert "other shards that are not there yet: 1" in said
        assert main([*words, "--shard", "2/2"]) == 0
        assert "wrote 2 train, 1 valid trajectories" in capsys.readouterr().out
        assert len(Split(tmp_path / "goop" / "train.h5")) == 2
        assert main([*words, "--shard", "3/2"]) == 1
        assert "shards are counted from 1" in capsys.readouterr().err
