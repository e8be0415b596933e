"""Fine-tuning from the command line: the weights that it starts with are the first checkpoint."""

import json
import re
from pathlib import Path

import pytest
import torch

from nmpm import TrajectoryDataModule, load_trajectories
from nmpm.cli import main
from nmpm.data.format import write_metadata, write_split
from nmpm.processors import Stochastic
from nmpm.training.checkpoints import read_checkpoint
from nmpm.zoo import Zoo
from tests.made_up import made_up_metadata, made_up_trajectory

TINY = """
model:
  cells: 16
  frames: 4
  unroll: 1
  schedule: {warmup: 1}
  processor: {class_path: nmpm.processors.UNet, init_args: {width: 4, depth: 1, perceptron: [4]}}
data: {batch_size: 2}
trainer:
  precision: 32-true
  val_check_interval: 1
  check_val_every_n_epoch: null
  num_sanity_val_steps: 0
  accelerator: cpu
  enable_progress_bar: false
  log_every_n_steps: 1
  gradient_clip_val: 1.0
"""
PATIENT = {"class_path": "lightning.pytorch.callbacks.EarlyStopping"}


@pytest.fixture
def fit(make_dataset, tmp_path):
    """Runs `nmpm fit` on made-up data with a learning rate and further words."""
    make_dataset(train=((30, 9),) * 2, valid=((30, 9),), test=((30, 9),)).rename(tmp_path / "data")
    Path("tiny.yaml").write_text(TINY)

    def fit(folder: str, steps: int, rate: float, *words: str) -> dict:
        optimizer = ["--model.optimizer", "torch.optim.SGD", "--model.optimizer.init_args.lr", str(rate)]
        given = ["--data.path", "data", "--trainer.max_steps", str(steps), "--trainer.default_root_dir", folder]
        assert main(["fit", "--config", "tiny.yaml", *optimizer, *given, *words]) == 0
        return json.loads(Path(folder, "report.json").read_text())

    return fit


def weights_of(run: str) -> dict[str, torch.Tensor]:
    return Zoo.load(run).emulator.state_dict()


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(values, other[name]) for name, values in one.items())


def test_an_ensemble_goes_on_from_a_deterministic_model_and_is_judged_by_its_members(fit):
    fit("first", 1, 1e-3)
    report = fit("members", 2, 1e-3, "--start_from", "first", "--model.members", "2", "--trainer.max_steps", "2")
    assert isinstance(Zoo.load("members").emulator.recipe.processor, Stochastic)
    assert len(report["curve"]) == 3  # the start counts
    assert main(["fit", "--resume", "members", "--trainer.max_steps", "3"]) == 0
    assert main(["test", "members", "--members", "3"]) == 0
    report = json.loads(Path("members", "report.json").read_text())
    assert report["ensemble"]["members"] == 3


def test_a_training_that_makes_it_worse_keeps_the_start(fit, capsys):
    fit("first", 3, 1e-2)
    report = fit("worse", 3, 1e3, "--start_from", "first")
    assert same(weights_of("first"), weights_of("worse"))
    assert read_checkpoint(Path("worse/checkpoints/best.ckpt"))["global_step"] == 0
    assert "None of the validations in 3 steps was better than that of the start" in report["progress"]
    assert report["progress"] in capsys.readouterr().out
    assert [steps for _, steps, *_ in report["curve"]] == [0, 1, 2, 3]
    assert report["test"]["mse"] == json.loads(Path("first/report.json").read_text())["test"]["mse"]


def test_a_training_that_makes_it_better_says_by_how_much(fit):
    assert "progress" not in fit("first", 1, 1e-4)
    report = fit("better", 3, 1e-3, "--start_from", "first")
    errors = [overall for *_, overall in report["curve"]]
    best = min(range(4), key=errors.__getitem__)
    assert best > 0
    assert report["progress"] == (
        f"valid/overall = {errors[0]:.3g} at the start, {errors[best]:.3g} after {best} of 3 steps, the best."
    )


def test_before_the_first_step_it_predicts_what_the_model_does(fit):
    report = fit("worse", 1, 1e-30, "--start_from", "goop")
    assert "None of the validations" in report["progress"]
    model, data = Zoo.load("goop").fit_to("data"), TrajectoryDataModule(path="data")
    data.reading = model.match.reading
    (window,) = data.test_dataloader()
    predicted = model.rollout(window.initial, window.target.shape[1])
    assert report["test"]["mse"] == pytest.approx(float((predicted - window.target).square().mean()), rel=1e-5)
    assert same(model.emulator.state_dict(), weights_of("worse"))


def test_early_stopping_counts_from_the_start(fit):
    fit("first", 3, 1e-2)
    stopping = PATIENT | {"init_args": {"monitor": "valid/overall", "patience": 2}}
    report = fit("worse", 9, 1e3, "--start_from", "first", "--trainer.callbacks", json.dumps([stopping]))
    assert report["training"]["steps"] == 2
    assert same(weights_of("first"), weights_of("worse"))


def test_a_resumed_fine_tuning_keeps_the_start_among_the_best(fit):
    fit("first", 3, 1e-2)
    fit("worse", 2, 1e3, "--start_from", "first")
    assert main(["fit", "--resume", "worse", "--trainer.max_steps", "4"]) == 0
    assert same(weights_of("first"), weights_of("worse"))
    report = json.loads(Path("worse/report.json").read_text())
    assert [steps for _, steps, *_ in report["curve"]] == [0, 1, 2, 3, 4]
    assert "None of the validations in 4 steps" in report["progress"]


def write_two_materials(folder: str, first: str, second: str) -> None:
    runs = [made_up_trajectory(30, 10, seed) for seed in range(2)]
    for run in runs:
        run.particle_type[::2] = 8
    for split in ("train", "valid", "test"):
        write_split(Path(folder, f"{split}.h5"), runs)
    write_metadata(Path(folder), made_up_metadata(particle_types={7: first, 8: second}))


@pytest.mark.parametrize("stated", [["--materials", "type1=sand,type2=sand"], []], ids=["stated", "chosen"])
def test_a_run_knows_which_materials_its_data_are(fit, stated, capsys):
    write_two_materials("named", "sand", "water")
    write_two_materials("grains", "type1", "type2")
    fit("first", 1, 1e-3, "--data.path", "named")
    capsys.readouterr()
    fit("tuned", 1, 1e-3, "--data.path", "grains", "--start_from", "first", *stated)
    said = capsys.readouterr().out
    aliases = dict(Zoo.load("tuned").scene.aliases)
    if stated:
        assert aliases == {"type1": "sand", "type2": "sand"}
        assert "Chosen" not in said
    else:
        pairs = re.search(r"Chosen by short rollouts, as nmpm zoo match does: --materials (\S+)\n", said)[1]
        assert aliases == dict(pair.split("=") for pair in pairs.split(","))
    assert main(["rollout", "tuned", "--data", "grains"]) == 0
    assert main(["test", "tuned"]) == 0
    assert main(["zoo", "add", "tuned", "entry", "--about", "Made up."]) == 0
    for model in map(Zoo.load, ("tuned", "entry")):
        assert model.start(load_trajectories("grains").test[0]).material.shape == (1, 10)
    assert main(["fit", "--resume", "tuned", "--trainer.max_steps", "2"]) == 0
    assert dict(Zoo.load("tuned").scene.aliases) == aliases
