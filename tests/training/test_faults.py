"""Things that go wrong from outside, by really doing them."""

import contextlib
import hashlib
import json
import os
import pickle
import re
import resource
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import lightning
import pytest
import torch
import yaml

from nmpm._support.shipped import shipped_folder
from nmpm.cli import main
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.errors import DataError, ZooError
from nmpm.processors import UNet
from nmpm.training import EmulatorModule
from nmpm.training.checkpoints import load_module
from nmpm.zoo import Zoo

FIT = [
    *("fit", "--config", "waterdrop.yaml", "--model.unroll", "1", "--model.processor.width", "4"),
    *("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false", "--trainer.precision", "32-true"),
    *("--data.batch_size", "2", "--resume.every_n_train_steps", "1", "--trainer.default_root_dir", "run"),
]


class Payload:
    def __reduce__(self):
        return (os.system, ("touch ran",))


@pytest.fixture
def data(make_dataset, tmp_path, monkeypatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    sizes = ((40, 9),) * 2
    return ["--data.path", str(make_dataset(train=sizes, valid=sizes, test=sizes))]


@pytest.fixture
def run(data) -> list[str]:
    assert main([*FIT, *data, "--trainer.max_steps", "2", "--trainer.val_check_interval", "2"]) == 0
    return data


@pytest.mark.parametrize("damage", ["truncated", "empty", "payload", "not a checkpoint"])
@pytest.mark.parametrize("command", ["fit", "test"])
def test_a_bad_checkpoint_is_refused_by_name_and_not_run(run, command, damage, capsys):
    path = Path("run/checkpoints/last.ckpt")
    whole = path.read_bytes()
    if damage == "payload":
        torch.save({"state_dict": {}, "trap": Payload()}, path)
    elif damage == "not a checkpoint":
        torch.save({"weights": torch.zeros(1)}, path)
    else:
        path.write_bytes(whole[: len(whole) // 2] if damage == "truncated" else b"")
    words = [command, *FIT[1:], *run, "--ckpt_path", str(path)]
    assert main(words) == 1
    assert str(path) in capsys.readouterr().err
    assert not Path("ran").exists()
    with pytest.raises(DataError, match=r"last\.ckpt"):
        load_module(path)


def test_a_bare_pickle_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("evil.ckpt").write_bytes(pickle.dumps(Payload()))
    with pytest.raises(DataError, match=r"evil\.ckpt"):
        load_module(Path("evil.ckpt"))
    assert not Path("ran").exists()


@pytest.mark.slow
def test_a_full_disk_ends_the_run_and_keeps_the_last_checkpoint(run, tmp_path):
    """The operating system refuses files as large as a checkpoint, as a full disk does."""
    path = Path("run/checkpoints/last.ckpt")
    before = path.read_bytes()
    limit = len(before) // 2
    words = [*FIT, *run, "--trainer.max_steps", "6", "--ckpt_path", "last"]
    ended = subprocess.run(
        [sys.executable, "-m", "nmpm", *words],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert ended.returncode != 0
    assert path.read_bytes() == before
    assert main([*words]) == 0
    assert torch.load(path, weights_only=True)["global_step"] == 6


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1])
def test_a_lost_process_is_named_in_one_line_and_the_run_goes_on_with_fewer(data, lost):
    words = [*FIT, *data, "--trainer.max_steps", "100000", "--trainer.max_time", "00:00:05:00"]
    spread = ["--trainer.devices", "2", "--trainer.strategy", "ddp", "--trainer.val_check_interval", "100000"]
    with Path("said").open("w") as said:
        first = subprocess.Popen(
            [sys.executable, "-m", "nmpm", *words, *spread],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdout=subprocess.DEVNULL,
            stderr=said,
            start_new_session=True,
        )
    last = Path("run/checkpoints/last.ckpt")
    try:
        wait_for(last.exists, first)
        (second,) = children(first.pid)
        killed = (first.pid, second)[lost]
        os.kill(killed, signal.SIGKILL)
        assert first.wait(timeout=120) != 0
        end = time.monotonic() + 120
        while not Path("said").read_text().endswith("\n") and time.monotonic() < end:
            time.sleep(0.05)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(first.pid, signal.SIGKILL)
    how = "was killed by SIGKILL" if lost else "has ended"
    found = re.fullmatch(
        rf"nmpm fit: rank {lost} \(process {killed}\) {how}: .*\. Go on with: nmpm (fit --resume run)\n",
        Path("said").read_text(),
    )
    assert found
    steps = torch.load(last, weights_only=True)["global_step"]
    assert steps > 0
    alone = ["--trainer.devices", "1", "--trainer.strategy", "auto"]
    more = ["--trainer.max_steps", str(steps + 2), "--trainer.max_time", "null", "--trainer.val_check_interval", "1"]
    assert main([*found[1].split(), *alone, *more]) == 0
    assert json.loads(Path("run/report.json").read_text())["training"]["steps"] == steps + 2


def wait_for(condition, process, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, "it ended too soon"
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.05)


def children(pid: int) -> list[int]:
    """Its Python processes that run nmpm."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    own = [int(word) for word in text.split()]
    return [child for child in own if b"nmpm" in Path(f"/proc/{child}/cmdline").read_bytes()]


class TestZoo:
    @pytest.fixture
    def root(self, tmp_path) -> Path:
        target = tmp_path / "zoo" / "goop"
        target.mkdir(parents=True)
        for path in (shipped_folder("zoo") / "goop").glob("*.*"):
            (target / path.name).write_bytes(path.read_bytes())
        return tmp_path / "zoo"

    def weigh(self, root: Path, content: bytes) -> None:
        """Put other weights into the entry, and their hash into its card, as somebody who means harm would."""
        (root / "goop" / "model.safetensors").write_bytes(content)
        card = yaml.safe_load((root / "goop" / "card.yaml").read_text())
        card["sha256"] = hashlib.sha256(content).hexdigest()
        (root / "goop" / "card.yaml").write_text(yaml.safe_dump(card))

    @pytest.mark.parametrize("size", [2**40, 2**63, 2**64 - 1])
    def test_an_oversized_header_is_refused(self, root, size):
        self.weigh(root, struct.pack("<Q", size) + b"{}")
        with pytest.raises(ZooError, match="not a file of tensors"):
            Zoo.load("goop", root)

    def test_offsets_beyond_the_file_are_refused(self, root):
        header = json.dumps({"w": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
        self.weigh(root, struct.pack("<Q", len(header)) + header)
        with pytest.raises(ZooError, match="not a file of tensors"):
            Zoo.load("goop", root)

    def test_a_pickle_in_its_place_is_refused(self, root, monkeypatch, tmp_path):
        monkeypatch.chdir(tmp_path)
        self.weigh(root, pickle.dumps(Payload()))
        with pytest.raises(ZooError, match="not a file of tensors"):
            Zoo.load("goop", root)
        assert not Path("ran").exists()

    @pytest.mark.parametrize("name", ["../goop", "/etc", "goop/../../etc", "goop/..", "GOOP", "goop\0", ""])
    def test_names_that_lead_elsewhere_are_refused(self, root, name):
        with pytest.raises(ZooError):
            Zoo.load(name, root)


@pytest.mark.parametrize(
    "content",
    [
        {"state_dict": {}},
        {"state_dict": {}, "hyper_parameters": []},
        {"state_dict": {}, "hyper_parameters": {"scene": 7}},
        {"state_dict": {}, "hyper_parameters": {"unroll": "many"}},
        {"state_dict": [1, 2], "hyper_parameters": {}},
    ],
)
def test_checkpoints_of_something_else_are_rejected_in_one_line(content, tmp_path):
    torch.save(content, tmp_path / "other.ckpt")
    with pytest.raises(DataError, match=r"other\.ckpt") as error:
        load_module(tmp_path / "other.ckpt")
    assert "\n" not in str(error.value)


def test_changed_weights_are_noticed(make_dataset, tmp_path):
    data = TrajectoryDataModule(path=str(make_dataset()), horizon=4, batch_size=2)
    model = EmulatorModule(data.scene, cells=8, frames=2, processor=UNet(width=4, depth=1, perceptron=(4,)))
    lightning.Trainer(max_steps=1, logger=False, enable_checkpointing=False, accelerator="cpu").fit(model, data)
    model.trainer.save_checkpoint(tmp_path / "sound.ckpt")
    content = torch.load(tmp_path / "sound.ckpt", weights_only=True)
    load_module(tmp_path / "sound.ckpt")
    name = next(name for name in content["state_dict"] if name.endswith("weight"))
    content["state_dict"][name].view(-1)[0] += 1e-3
    torch.save(content, tmp_path / "changed.ckpt")
    with pytest.raises(DataError, match=r"changed\.ckpt is damaged: its weights are not those that were saved"):
        load_module(tmp_path / "changed.ckpt")
