"""Ctrl-C, SIGTERM, kills at every moment, a full disk, and several processes in one folder."""

import functools
import json
import multiprocessing
import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml
from lightning.pytorch import Callback

from nmpm.cli import main
from nmpm.cli.run_folder import RunFolder, next_folder
from nmpm.errors import ConfigError
from tests.conftest import make_dataset

FIT = [
    *("fit", "--config", "waterdrop.yaml", "--config", "mine.yaml", "--model.unroll", "1", "--data.batch_size", "2"),
    *("--model.cells", "8", "--model.processor.width", "2", "--model.processor.depth", "1"),
    *("--model.processor.perceptron", "[2]", "--model.optimizer.lr", "0.3", "--model.schedule.warmup", "0"),
    *("--trainer.accelerator", "cpu", "--trainer.precision", "32-true", "--trainer.enable_progress_bar", "false"),
    *("--trainer.max_steps", "5", "--trainer.val_check_interval", "2", "--resume.every_n_train_steps", "2"),
]
AVERAGING = {"class_path": "lightning.pytorch.callbacks.EMAWeightAveraging", "init_args": {"decay": 0.5}}
SAVING = "nmpm.training.checkpoints:torch.save"
BEST = "nmpm.training.callbacks.savers:BestCheckpoint"
LAST = "nmpm.training.callbacks.savers:LastCheckpoint"
MODULE = "nmpm.training.module:EmulatorModule"
# Saved are last.ckpt at step 2 and before its validation, best.ckpt and last.ckpt after it, …
MOMENTS = {
    "when a step is over": (f"{LAST}.on_train_batch_end", 2),
    "before a validation": (f"{LAST}.on_validation_start", 1),
    "in the first validation": (f"{MODULE}.validation_step", 1),
    "in the second validation": (f"{MODULE}.validation_step", 2),
    "after a validation": (f"{BEST}.on_validation_end", 1),
    "after one that is not the best": (f"{BEST}.on_validation_end", 2),
    "within last.ckpt before a validation": (SAVING, 2),
    "within best.ckpt": (SAVING, 3),
    "between best.ckpt and last.ckpt": (f"{LAST}.on_validation_end", 1),
    "within last.ckpt after a validation": (SAVING, 4),
    "when the last step is over": (f"{LAST}.on_train_batch_end", 5),
    "in the closing validation": (f"{MODULE}.validation_step", 3),
    "in the closing test": (f"{MODULE}.test_step", 1),
    "within the report": ("nmpm.training.callbacks.outputs:json.dumps", 1),
}


def kill_at(name: str, call: int) -> None:
    """Have this process killed within a call of a function; one that writes a file has written half of it."""
    module, _, attributes = name.partition(":")
    *parents, attribute = attributes.split(".")
    owner = functools.reduce(getattr, parents, import_module(module))
    original, calls = getattr(owner, attribute), iter(range(1, 1000))

    @functools.wraps(original)
    def killed(*args, **options):
        if next(calls) == call:
            if name == SAVING:
                original(*args, **options)
                os.truncate(args[1], Path(args[1]).stat().st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*args, **options)

    setattr(owner, attribute, killed)


def run(folder: str, words: list[str], moment: tuple[str, int] | None = None) -> None:
    os.chdir(folder)
    output = os.open("output.txt", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    os.dup2(output, 1), os.dup2(output, 2)
    for name in ("write_animation", "write_snapshots"):  # which take most of the time
        setattr(import_module("nmpm.training.callbacks.outputs"), name, lambda *_: None)
    if moment:
        kill_at(*moment)
    raise SystemExit(main(words))


def start(folder: Path, words: list[str], *moment: tuple[str, int]) -> int:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["nmpm.cli.run_training"])
    process = context.Process(target=run, args=(str(folder), words, *moment))
    process.start()
    process.join()
    return process.exitcode


def plain(value):
    """Tensors as lists, which can be compared."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value.tolist() if isinstance(value, torch.Tensor) else value


def outcome(run: Path) -> dict:
    """All that a run leaves, apart from times."""
    files = {name: torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True) for name in ("best", "last")}
    report = json.loads((run / "report.json").read_text())
    del report["training"]["seconds"]
    report["curve"] = [point[1:] for point in report["curve"]]
    parts = ("state_dict", "current_model_state", "optimizer_states", "lr_schedulers", "global_step")
    states = {name: plain({part: content[part] for part in parts}) for name, content in files.items()}
    return {"report": report, "names": sorted(path.name for path in (run / "checkpoints").iterdir()), **states}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of an uninterrupted run, with its data."""
    folder = tmp_path_factory.mktemp("whole")
    sizes = ((40, 9),) * 2
    data = make_dataset.__wrapped__(folder)(train=sizes, valid=sizes, test=sizes)
    (folder / "mine.yaml").write_text(yaml.safe_dump({"trainer": {"callbacks": [AVERAGING]}}))
    assert start(folder, [*FIT, "--data.path", str(data), "--trainer.default_root_dir", "run"]) == 0
    return folder


@pytest.mark.parametrize(
    "moment",
    [
        pytest.param(moment, id=name, marks=[] if name == "within best.ckpt" else [pytest.mark.slow])
        for name, moment in MOMENTS.items()
    ],
)
def test_a_killed_training_goes_on_to_the_same_end(whole, tmp_path, moment):
    shutil.copy(whole / "mine.yaml", tmp_path)
    words = [*FIT, "--data.path", str(whole / "dataset"), "--trainer.default_root_dir", "run"]
    assert start(tmp_path, words, moment) == -signal.SIGKILL
    more = ["fit", "--resume", "run"] if (tmp_path / "run/checkpoints/last.ckpt").is_file() else words
    assert start(tmp_path, more) == 0
    assert outcome(tmp_path / "run") == outcome(whole / "run")


@pytest.fixture
def moved(whole, tmp_path):
    """The folder of a copied run, whose best weights those of further steps do not reach."""
    return Path(shutil.copytree(whole / "run", tmp_path / "moved"))


def go_on(moved: Path, path: str) -> tuple[list[list[float]], str]:
    """Two further steps; steps, MSE and overall error of each validation, and the output."""
    assert start(moved.parent, ["fit", "--resume", path, "--trainer.max_steps", "7"]) == 0
    report = outcome(moved)["report"]
    return report["curve"], " ".join((moved.parent / "output.txt").read_text().split())


def test_a_moved_run_keeps_its_best_weights(whole, moved):
    best = (moved / "checkpoints/best.ckpt").read_bytes()
    curve, output = go_on(moved, "moved")
    errors = [error for _, _, error in curve]
    assert min(errors) < min(errors[-2:])  # of the further steps
    assert (moved / "checkpoints/best.ckpt").read_bytes() == best
    assert f"Going on from step 5; best so far: valid/overall = {min(errors):.4g} (best.ckpt)." in output
    assert outcome(moved)["report"]["weights"] == outcome(whole / "run")["report"]["weights"]


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["deleted", "damaged"])
def test_lost_best_weights_are_named_and_no_score_is_claimed_for_them(moved, loss):
    best = moved / "checkpoints" / "best.ckpt"
    os.truncate(best, 1000) if loss == "damaged" else best.unlink()
    curve, output = go_on(moved, "moved")
    assert "Going on from step 5 without the best weights so far: best.ckpt is not in" in output
    assert ("best.ckpt cannot be read as a checkpoint" in output) == (loss == "damaged")
    content = torch.load(best, weights_only=True)
    steps = {step: error for step, _, error in curve}
    assert content["global_step"] == min((6, 7), key=steps.__getitem__)


@pytest.mark.slow
def test_a_full_disk_ends_the_run_and_keeps_the_last_checkpoint(moved):
    """The operating system refuses files as large as a checkpoint, as a full disk does."""
    path = moved / "checkpoints/last.ckpt"
    before = path.read_bytes()
    words = ["fit", "--resume", str(moved), "--trainer.max_steps", "7"]
    limit = (len(before) // 2,) * 2
    ended = subprocess.run(
        [sys.executable, "-m", "nmpm", *words],
        capture_output=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit),
    )
    assert ended.returncode != 0
    assert path.read_bytes() == before
    assert start(moved.parent, words) == 0


class Signal(Callback):
    """Sends this process, once, a signal after a step or in the middle of the validation after it."""

    armed = False

    def __init__(self, kind: int, step: int, validating: bool):
        self.kind, self.step, self.validating = kind, step, validating

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self._send(trainer.global_step == self.step and not self.validating)

    def on_validation_batch_start(self, trainer, *_):
        self._send(trainer.global_step == self.step and self.validating)

    def _send(self, due):
        if due and Signal.armed:
            Signal.armed = False
            os.kill(os.getpid(), self.kind)


@pytest.mark.parametrize(
    ("kind", "step", "validating"),
    [
        pytest.param(signal.SIGINT, 2, True, marks=pytest.mark.slow),
        (signal.SIGTERM, 1, False),
    ],
)
def test_an_interrupted_training_goes_on_by_the_command_that_it_prints(
    whole, tmp_path, monkeypatch, capfd, kind, step, validating
):
    monkeypatch.chdir(tmp_path)
    handlers = [signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)]
    sender = {
        "class_path": f"{__name__}.Signal",
        "init_args": {"kind": int(kind), "step": step, "validating": validating},
    }
    Path("mine.yaml").write_text(yaml.safe_dump({"trainer": {"callbacks": [AVERAGING, sender]}}))
    Signal.armed = True
    words = [*FIT, "--data.path", str(whole / "dataset"), "--trainer.default_root_dir", "run"]
    assert main(words) == 130
    stopped = step + (not validating)
    said = capfd.readouterr().err
    command = re.search(
        rf"^nmpm fit: stopped at step {stopped}\. Go on with: nmpm (fit --resume run --trust-config)$", said, re.M
    )
    assert command
    assert "Traceback" not in said
    assert torch.load("run/checkpoints/last.ckpt", weights_only=True)["global_step"] == stopped
    assert [signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert main(shlex.split(command[1])) == 0
    assert outcome(Path("run")) == outcome(whole / "run")


def test_an_interruption_before_training_says_that_the_same_command_starts_again(whole, tmp_path, monkeypatch, capfd):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    shutil.copy(whole / "mine.yaml", tmp_path)
    monkeypatch.setattr("nmpm.data.datamodule.TrajectoryDataModule.prepare_data", interrupt)
    words = [*FIT, "--data.path", str(whole / "dataset"), "--trainer.default_root_dir", "run"]
    assert main(words) == 130
    message = "interrupted before the first step. The same command starts again; simulated trajectories are kept."
    assert message in capfd.readouterr().err
    assert main([*words, "--ckpt_path", "last"]) == 1
    assert "there is no run/checkpoints/last.ckpt; checkpoints there: none" in capfd.readouterr().err


HOLD = """
import sys, time
from pathlib import Path
from nmpm.cli.run_folder import RunFolder
with RunFolder(Path(sys.argv[1]), {}).lock():
    print("locked", flush=True)
    time.sleep(60)
"""


def test_a_folder_is_trained_in_by_one_process_and_free_again_when_that_is_killed(tmp_path):
    held = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    folder = RunFolder(tmp_path, {})
    try:
        assert held.stdout.readline() == "locked\n"
        with pytest.raises(ConfigError, match=rf"process \({held.pid}\) is training in"):
            folder.lock().__enter__()
    finally:
        held.kill()
        held.wait()
    with folder.lock():
        pass


def touch(*paths):
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_a_new_run_takes_the_next_folder_and_an_unfinished_one_is_named(tmp_path):
    root, first, second = tmp_path / "my runs", tmp_path / "my runs/version_1", tmp_path / "my runs/version_2"
    touch(root / "logs/metrics.csv", root / "config.yaml", root / ".lock")  # killed before its first checkpoint
    assert next_folder(root) == (root, "")
    touch(root / "checkpoints/best.ckpt", root / "report.json")
    assert next_folder(root) == (first, f"{root} holds a run; this is a new one.\n")
    touch(first / "checkpoints/last.ckpt")
    command = f"nmpm fit --resume '{first}'"
    note = f"{first} holds an unfinished run, with which {command} goes on; this is a new one.\n"
    assert next_folder(root) == (second, note)
    touch(second / "report.json")
    assert next_folder(root) == (root / "version_3", note)


@pytest.mark.parametrize("old", ["checkpoints/best.ckpt", "checkpoints/last.ckpt", "report.json"])
def test_a_run_is_not_written_over(tmp_path, old):
    folder = RunFolder(tmp_path, {name: tmp_path / "checkpoints" / f"{name}.ckpt" for name in ("last", "best")})
    folder.check_new()
    touch(tmp_path / old)
    with pytest.raises(ConfigError, match=rf"{tmp_path / old} is of another run, and would be written over: choose"):
        folder.check_new()


@pytest.mark.parametrize(
    ("old", "mend"),
    [
        ([], "call nmpm fit with --config alone"),
        (["checkpoints/best.ckpt"], "give --ckpt_path .*/best.ckpt"),
    ],
)
def test_a_checkpoint_that_is_not_there_is_answered_by_what_then_works(tmp_path, old, mend):
    """It advised a fit without it, which refused a folder that already held a run."""
    folder = RunFolder.of(tmp_path, {})
    for name in old:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(ConfigError, match=mend):
        folder.checkpoint("last")
    if not old:
        folder.check_new()
