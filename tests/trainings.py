"""Small trainings that record each batch; as a script (under torchrun) it runs those of a JSON file on each rank."""

import json
import sys
from pathlib import Path

import lightning
import torch

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.optimizers import SOAP
from nmpm.particles import Window
from nmpm.processors import UNet
from nmpm.training import EmulatorModule
from nmpm.training.schedules import Schedule

TINY = UNet(width=4, depth=1, perceptron=(4,))


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


def data_of(folder: Path, **options) -> TrajectoryDataModule:
    known = {"path": str(folder), "horizon": 4, "batch_size": 4, "buffer_size": 2, "passes": 1.0}
    return TrajectoryDataModule(**(known | options))


def train(folder: Path, last: Path, devices: int = 1, ckpt_path: Path | None = None, **options) -> dict:
    """Train, write the last checkpoint to the file `last`, and return the record."""
    module = data_of(folder, **options.pop("data", {}))
    noise = {"position_noise": 1e-4, "grid_noise": 0.01, "mirror": (0,), "jitter": 0.15}
    model = {"unroll": 2} | noise | options.pop("model", {})
    if options.pop("soap", False):
        model["optimizer"] = SOAP
    torch.manual_seed(0)
    schedule = Schedule(warmup=30)
    emulator = EmulatorModule(module.scene, cells=8, frames=2, processor=TINY, schedule=schedule, **model)
    emulator.emulator.calibrated.fill_(options.pop("calibrated", False))
    record = Record()
    trainer = lightning.Trainer(
        accelerator="cpu",
        devices=devices,
        strategy="ddp" if devices > 1 else "auto",
        default_root_dir=last.parent,
        callbacks=[record],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
        **options,
    )
    trainer.fit(emulator, module, ckpt_path=ckpt_path, weights_only=True)
    trainer.save_checkpoint(last)
    weights = torch.cat([value.double().flatten() for value in emulator.state_dict().values()])
    return {
        "losses": record.losses,
        "windows": record.windows,
        "rates": record.rates,
        "seeds": record.seeds,
        "weights": weights.tolist(),
        "rank": trainer.global_rank,
    }


if __name__ == "__main__":
    plan = Path(sys.argv[1])
    for name, run in json.loads(plan.read_text()).items():
        before = run.pop("ckpt_path", None)
        record = train(Path(run.pop("folder")), plan.parent / f"{name}.ckpt", 2, before and Path(before), **run)
        (plan.parent / f"{name}-{record['rank']}.json").write_text(json.dumps(record))
