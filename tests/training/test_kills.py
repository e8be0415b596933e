"""Killed by -9 at any moment, or moved, and resumed, a training leaves what an uninterrupted one leaves."""

import functools
import json
import multiprocessing
import os
import shutil
import signal
from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml

from nmpm.cli import main
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
BEST = "nmpm.training.callbacks.best_checkpoint:BestCheckpoint"
LAST = "nmpm.training.callbacks.last_checkpoint:LastCheckpoint"
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
    "within the report": ("nmpm.training.callbacks.report:json.dumps", 1),
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
    said = os.open("said.txt", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    os.dup2(said, 1), os.dup2(said, 2)
    for name in ("write_animation", "write_snapshots"):  # which take most of the time
        setattr(import_module("nmpm.training.callbacks.report"), name, lambda *_: None)
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


@pytest.mark.parametrize("moment", MOMENTS.values(), ids=MOMENTS)
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
    """Two further steps; steps, MSE and overall error of each validation, and what was said."""
    assert start(moved.parent, ["fit", "--resume", path, "--trainer.max_steps", "7"]) == 0
    report = outcome(moved)["report"]
    return report["curve"], " ".join((moved.parent / "said.txt").read_text().split())


@pytest.mark.parametrize("path", ["moved", "link", "absolute"])
def test_a_moved_run_keeps_its_best_weights(whole, moved, path):
    (moved.parent / "link").symlink_to("moved")
    best = (moved / "checkpoints/best.ckpt").read_bytes()
    curve, said = go_on(moved, str(moved) if path == "absolute" else path)
    errors = [error for _, _, error in curve]
    assert min(errors) < min(errors[-2:])  # of the further steps
    assert (moved / "checkpoints/best.ckpt").read_bytes() == best
    assert f"Going on from step 5; best so far: valid/overall = {min(errors):.4g} (best.ckpt)." in said
    assert outcome(moved)["report"]["weights"] == outcome(whole / "run")["report"]["weights"]


@pytest.mark.parametrize("loss", ["deleted", "damaged"])
def test_lost_best_weights_are_said_to_be_and_no_score_is_claimed_for_them(moved, loss):
    best = moved / "checkpoints" / "best.ckpt"
    os.truncate(best, 1000) if loss == "damaged" else best.unlink()
    curve, said = go_on(moved, "moved")
    assert "Going on from step 5 without the best weights so far: best.ckpt is not in" in said
    assert ("best.ckpt cannot be read as a checkpoint" in said) == (loss == "damaged")
    content = torch.load(best, weights_only=True)
    steps = {step: error for step, _, error in curve}
    assert content["global_step"] == min((6, 7), key=steps.__getitem__)


def test_a_run_is_branched_into_a_folder_of_its_own_only(whole, moved):
    shutil.copytree(moved, moved.parent / "other")
    last = str(moved / "checkpoints/last.ckpt")
    words = ["fit", "--resume", "other", "--ckpt_path", last]
    assert start(moved.parent, words) == 1
    assert "other already holds a run (best.ckpt)" in (moved.parent / "said.txt").read_text()
