"""Small trainings for tests; as a script (under torchrun) it runs those of a JSON file, recorded, on each rank."""

import json
import sys
from pathlib import Path

import lightning
import torch
from lightning.pytorch.callbacks import EMAWeightAveraging, ModelCheckpoint

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.metrics import MSE
from nmpm.optimizers import SOAP
from nmpm.particles import Window
from nmpm.processors import UNet
from nmpm.training import EmulatorModule
from nmpm.training.optimization import Schedule

TINY = UNet(width=4, depth=1, perceptron=(4,))
QUIET = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "num_sanity_val_steps": 0}


def data_of(folder: Path, **options) -> TrajectoryDataModule:
    return TrajectoryDataModule(**({"path": str(folder), "horizon": 4, "batch_size": 2} | options))


def module_of(data: TrajectoryDataModule, **changes) -> EmulatorModule:
    torch.manual_seed(0)
    options = {"cells": 8, "frames": 2, "unroll": 2, "processor": TINY, "position_noise": 1e-4}
    options |= {"grid_noise": 0.01, "metrics": [MSE((1, 4))]}
    return EmulatorModule(data.scene, **(options | changes))


def trainer_of(root: Path, steps: int, *callbacks: lightning.Callback, **options) -> lightning.Trainer:
    """A trainer that averages weights, validates every second step, and writes `last.ckpt` then."""
    averaging = EMAWeightAveraging(decay=0.5, use_buffers=False)
    last = ModelCheckpoint(root, filename="last", every_n_train_steps=2, enable_version_counter=False)
    steps = {"max_steps": steps, "val_check_interval": 2, "check_val_every_n_epoch": None, "gradient_clip_val": 1.0}
    given = {"accelerator": "cpu", "default_root_dir": root, **QUIET, **steps, **options}
    return lightning.Trainer(callbacks=[averaging, last, *callbacks], **given)


def fingerprints(batch: Window) -> list[str]:
    """One number for each window of a batch, as text, that tells the windows apart."""
    real = batch.frames.double() * batch.mask[:, None, :, None]  # padding is that of the batch
    return [f"{total:.10g}" for total in real.sum((1, 2, 3)).tolist()]


class Record(lightning.Callback):
    """Keeps the windows, loss, learning rate and seed of every batch."""

    def __init__(self):
        self.windows, self.losses, self.rates, self.seeds = [], [], [], []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.windows.append(fingerprints(batch))

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.seeds.append(torch.initial_seed())
        self.losses.append(trainer.callback_metrics["train/loss"].item())
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])


def train(folder: Path, last: Path, devices: int = 1, ckpt_path: Path | None = None, **options) -> dict:
    """Train, write the last checkpoint to the file `last`, and return the record."""
    data = data_of(folder, **({"batch_size": 4, "buffer_size": 2, "passes": 1.0} | options.pop("data", {})))
    noise = {"position_noise": 1e-4, "grid_noise": 0.01, "mirror": (0,), "jitter": 0.15}
    optimizer = {"optimizer": SOAP} if options.pop("soap", False) else {}
    model = {"schedule": Schedule(warmup=30), "metrics": None} | noise | options.pop("model", {}) | optimizer
    module, record = module_of(data, **model), Record()
    module.emulator.calibrated.fill_(options.pop("calibrated", False))
    averaging = [EMAWeightAveraging(decay=0.8, use_buffers=False)] if options.pop("average", False) else []
    strategy = "ddp" if devices > 1 else "auto"
    quiet = {**QUIET, "accelerator": "cpu", "enable_checkpointing": False, "limit_val_batches": 0}
    trainer = lightning.Trainer(
        devices=devices,
        strategy=strategy,
        default_root_dir=last.parent,
        callbacks=[record, *averaging],
        **quiet,
        **options,
    )
    trainer.fit(module, data, ckpt_path=ckpt_path, weights_only=True)
    trainer.save_checkpoint(last)
    weights = torch.cat([value.double().flatten() for value in module.emulator.state_dict().values()])
    kept = {name: getattr(record, name) for name in ("windows", "losses", "rates", "seeds")}
    return kept | {"weights": weights.tolist(), "rank": trainer.global_rank}


if __name__ == "__main__":
    plan = Path(sys.argv[1])
    for name, run in json.loads(plan.read_text()).items():
        before = run.pop("ckpt_path", None)
        record = train(Path(run.pop("folder")), plan.parent / f"{name}.ckpt", 2, before and Path(before), **run)
        (plan.parent / f"{name}-{record['rank']}.json").write_text(json.dumps(record))
