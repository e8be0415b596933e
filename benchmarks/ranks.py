"""Training on several ranks: the table of windows per second and efficiency, from one command.

python benchmarks/ranks.py                              1, 2, 4, … ranks up to all GPUs; without a GPU 1 and 2 processes
python benchmarks/ranks.py --ranks 1 2 4 8 --batch 32 --width 64 --json ranks.json
python benchmarks/ranks.py --data FOLDER                on other data than goop, which is simulated on first use

Each number of ranks is a training of its own by Lightning's DDP, as of `nmpm fit --trainer.devices N`, data included.
The batch is per rank: N ranks have N times the windows of one in each step. Efficiency is windows per second and rank
over those of the first line's median. Figures are the median (least-most) of rounds of steps.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, Trainer
from timing import Spread, make_timing_parser, wall_clock, write_json

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.evaluation.machine import describe_device
from nmpm.processors import UNet
from nmpm.training import EmulatorModule
from nmpm.training.preflight import fitting_precision

FRAMES, UNROLL = 8, 4
SIZES = ("batch", "width", "steps", "rounds")


class RoundTimes(Callback):
    """Seconds of each round of so many steps after the first, in which memory is allocated."""

    def __init__(self, steps: int) -> None:
        self.seconds: list[float] = []
        self._steps, self._since = steps, 0.0

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        """Take the time at the end of a round."""
        if trainer.global_step % self._steps == 0:
            now = wall_clock()
            if trainer.global_step > self._steps:
                self.seconds.append(now - self._since)
            self._since = now


def train(chosen: argparse.Namespace, ranks: int) -> None:
    """Train as one of so many ranks; rank 0 writes the seconds of the rounds to a file."""
    source = {"path": str(chosen.data)} if chosen.data else {"name": "goop"}
    data = TrajectoryDataModule(**source, horizon=FRAMES * UNROLL, batch_size=chosen.batch)  # type: ignore[arg-type]
    network = UNet(width=chosen.width, perceptron=(chosen.width,))
    times, device = RoundTimes(chosen.steps), chosen.device
    trainer = Trainer(
        accelerator="gpu" if device.type == "cuda" else device.type,
        devices=ranks,
        strategy="ddp" if ranks > 1 else "auto",
        precision=fitting_precision("bf16-mixed", device),  # type: ignore[arg-type]  # (a plain text)
        max_steps=chosen.steps * (chosen.rounds + 1),
        limit_val_batches=0,
        gradient_clip_val=1.0,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[times],
    )
    data.prepare_data()
    data.setup("fit")
    trainer.fit(EmulatorModule(data.scene, frames=FRAMES, unroll=UNROLL, processor=network), datamodule=data)
    if trainer.is_global_zero:
        chosen.measured.write_text(json.dumps(times.seconds))


def measure(chosen: argparse.Namespace, ranks: int) -> Spread:
    """Seconds of the rounds of a training on so many ranks, in processes of their own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "seconds.json"
        words = ["--device", str(chosen.device), "--ranks", str(ranks), "--measured", str(path)]
        words += ["--data", str(chosen.data)] if chosen.data else []
        words += [word for name in SIZES for word in (f"--{name}", str(getattr(chosen, name)))]
        environment = os.environ | {"OMP_NUM_THREADS": str(chosen.threads)}
        subprocess.run([sys.executable, __file__, *words], check=True, env=environment)
        return Spread.of(json.loads(path.read_text()))


def usual_ranks(device: torch.device) -> list[int]:
    """Powers of two up to the number of GPUs, and that number; 1 and 2 on a CPU."""
    most = torch.cuda.device_count() if device.type == "cuda" else 2
    return sorted({2**power for power in range(most.bit_length())} | {most})


def windows_per_second(spent: Spread, windows: int) -> Spread:
    """Of rounds of so many windows."""
    return Spread(windows / spent.median, windows / spent.most, windows / spent.least)


def main() -> None:
    """Measure and print the table, or train as one of its lines."""
    parser = make_timing_parser(__doc__)
    parser.set_defaults(threads=1)
    parser.add_argument("--ranks", type=int, nargs="+")
    parser.add_argument("--data", type=Path, help="a dataset (default: goop)")
    for name, number in zip(SIZES, (8, 32, 20, 7), strict=True):
        parser.add_argument(f"--{name}", type=int, default=number)
    parser.add_argument("--measured", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.measured:
        train(chosen, *chosen.ranks)
        return
    sizes = {name: getattr(chosen, name) for name in SIZES}
    sys.stdout.write(f"{describe_device(chosen.device)}, torch {torch.__version__}; {sizes}\n")
    sys.stdout.write("ranks" + "".join(f"{title:>28}" for title in ("windows/s", "efficiency", "step, ms")) + "\n")
    rows: list[dict[str, Any]] = []
    for ranks in chosen.ranks or usual_ranks(chosen.device):
        spent = measure(chosen, ranks)
        rate = windows_per_second(spent, ranks * chosen.batch * chosen.steps)
        rows.append({"ranks": ranks, "windows_per_s": rate, "round_s": spent})
        one = ranks * rows[0]["windows_per_s"].median / rows[0]["ranks"]
        texts = (rate.format(1), rate.format(one), spent.format(1e-3 * chosen.steps))
        sys.stdout.write(f"{ranks:>5}" + "".join(f"{text:>28}" for text in texts) + "\n")
        sys.stdout.flush()
    write_json(chosen.json, {"device": describe_device(chosen.device), "sizes": sizes, "rows": rows})


if __name__ == "__main__":
    main()
