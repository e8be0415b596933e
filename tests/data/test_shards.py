"""A dataset in shards, as the tasks of a job array simulate it."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nmpm.cli import main
from nmpm.data.format import Split
from nmpm.data.generate import generate, generate_shard
from nmpm.data.simulation import Shard
from nmpm.errors import ConfigError, DataError
from tests.data import tiny_goop
from tests.data.tiny_goop import COUNTS, fingerprints

TINY = dataclasses.replace(tiny_goop.TINY, frames=10)

SIMULATE = """
import json, sys
from pathlib import Path
from nmpm.data.generate import generate_shard
from nmpm.data.simulation import Shard
from nmpm.sim import preset_from_dict
preset, folder, counts, index, count = sys.argv[1:]
shard = Shard(int(index), int(count))
print(generate_shard(preset_from_dict(json.loads(preset)), Path(folder), json.loads(counts), shard, seed=5, workers=1))
"""


def run_shard(folder: Path, index: int, count: int, seed: int = 5) -> int:
    return generate_shard(TINY, folder, COUNTS, Shard(index, count), seed, workers=1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    generate(TINY, folder, COUNTS, seed=5, workers=1)
    return folder


def test_the_last_shard_completes_the_bytes_of_one_process(whole, tmp_path):
    assert run_shard(tmp_path, 2, 2) == 4
    assert not list(tmp_path.glob("*.h5"))
    assert run_shard(tmp_path, 1, 2) == 0
    assert fingerprints(tmp_path) == fingerprints(whole)
    assert run_shard(tmp_path, 2, 3) == 0  # complete: nothing is done
    assert not (tmp_path / ".parts").exists()


def test_shards_at_the_same_time_give_the_same_bytes(whole, tmp_path):
    arguments = [sys.executable, "-c", SIMULATE, json.dumps(TINY.to_dict()), str(tmp_path), json.dumps(COUNTS)]
    processes = [subprocess.Popen([*arguments, str(index), "3"], stdout=subprocess.PIPE) for index in (1, 2, 3)]
    missing = [int(process.communicate(timeout=120)[0]) for process in processes]
    assert 0 in missing
    assert fingerprints(tmp_path) == fingerprints(whole)


def test_parts_of_machines_without_a_common_folder_are_merged(whole, tmp_path):
    """As `rsync a/.parts/ b/.parts/` does; the command without a shard then simulates nothing new."""
    for index, name in ((1, "a"), (2, "b")):
        run_shard(tmp_path / name, index, 2)
    shutil.copytree(tmp_path / "a" / ".parts", tmp_path / "b" / ".parts", dirs_exist_ok=True)
    generate(TINY, tmp_path / "b", COUNTS, seed=5, workers=1)
    assert fingerprints(tmp_path / "b") == fingerprints(whole)


def test_shards_of_different_datasets_do_not_mix(tmp_path):
    run_shard(tmp_path, 1, 2, seed=1)
    with pytest.raises(DataError, match="seed is 1, requested 2"):
        run_shard(tmp_path, 2, 2, seed=2)


@pytest.mark.parametrize("text", ["0/4", "5/4", "1", "a/b", "²/4"])
def test_wrong_shards_are_refused(text):
    with pytest.raises(ConfigError, match="as in 1/8, 2/8"):
        Shard.parse(text)


def test_the_command_says_what_is_missing(tmp_path, capsys):
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
