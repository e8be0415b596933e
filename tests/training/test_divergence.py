"""The warning of a training whose loss has risen."""

import warnings
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.strategies import SingleDeviceStrategy

from nmpm.training.callbacks.divergence import MOST_RISE, RECENT, DivergedError, DivergenceGuard


def follow(losses, savers=()):
    """A guard to which the losses were logged, one every 20 steps."""
    guard, step = DivergenceGuard(), 0
    for loss in losses:
        step += 20
        trainer = SimpleNamespace(
            global_step=step,
            log_every_n_steps=20,
            checkpoint_callbacks=list(savers),
            strategy=SingleDeviceStrategy("cpu"),
        )
        guard.on_train_batch_end(trainer, None, {"loss": torch.tensor(loss)}, None, 0)


def test_a_loss_that_stays_high_is_told_once_with_the_best_checkpoint():
    best, last = ModelCheckpoint(monitor="valid/mse"), ModelCheckpoint()
    best.best_model_path, last.best_model_path = "run/checkpoints/best.ckpt", "run/checkpoints/last.ckpt"
    with pytest.warns(UserWarning, match="seems to have diverged") as told:
        follow([1.0] * 30 + [50.0] * 30, [last, best])
    assert len(told) == 1
    text = str(told[0].message)
    assert "50 times its least" in text
    assert "start again --start_from run/checkpoints/best.ckpt with a lower model.optimizer.init_args.lr" in text
    assert "or with fewer frames to backpropagate through" in text


@pytest.mark.parametrize(
    "losses",
    [
        [100.0 * 0.9**step for step in range(100)],
        [1.0] * 20 + [1000.0] * (RECENT // 2 - 1) + [1.0] * 20,
        [1.0] * 20 + [0.9 * MOST_RISE] * 20,
        [1.0] * (RECENT - 1),
    ],
    ids=["falls", "a few high ones", "not far enough", "too few"],
)
def test_losses_that_fall_or_scatter_are_no_divergence(losses):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        follow(losses)


@pytest.mark.parametrize(("before", "good"), [([1.0] * 30, ["best", "last"]), ([1.0] * 30 + [50.0] * 30, ["best"])])
@pytest.mark.filterwarnings("ignore:At step")
def test_a_checkpoint_from_after_the_rise_is_not_called_good(tmp_path, before, good):
    savers = [ModelCheckpoint(tmp_path, "best", monitor="valid/mse"), ModelCheckpoint(tmp_path, "last")]
    for name in ("best", "last"):
        (tmp_path / f"{name}.ckpt").touch()
    with pytest.raises(DivergedError, match="the loss is nan") as error:
        follow([*before, float("nan")], savers)
    named = [name for name in ("best", "last") if f"{name}.ckpt" in str(error.value)]
    assert named == good
