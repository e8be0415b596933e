"""Measures whether training waits for its data: windows per second of the buffer, and the share of time spent waiting.

python benchmarks/streaming.py                    goop from disk and live from the simulator, 60 steps each
python benchmarks/streaming.py --path FOLDER --family deepmind --gravity 0 -9.81
python benchmarks/streaming.py --steps 200 --json streaming.json
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.profilers import SimpleProfiler

from nmpm._support.messages import counted
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.processors import UNet
from nmpm.training import EmulatorModule

FRAMES, UNROLL, BATCH, PASSES, EMPHASIS = 8, 4, 8, 0.25, 0.5  # those of configs/goop.yaml
WAITING = "[_TrainingEpochLoop].train_dataloader_next"
REPEATS = 5


class QuietProfiler(SimpleProfiler):
    """A profiler that prints no table."""

    def summary(self) -> str:
        return ""


def buffer_rate(data: TrajectoryDataModule, batches: int = 40) -> list[float]:
    """Windows per second from a filled buffer, in several repetitions."""
    rates = []
    loader = iter(data.train_dataloader())
    next(loader)
    for _ in range(REPEATS):
        start = time.perf_counter()
        for _ in islice(loader, batches):
            pass
        rates.append(batches * data.batch_size / (time.perf_counter() - start))
    return rates


def training_rate(data: TrajectoryDataModule, steps: int) -> dict[str, float]:
    """Windows per second of a training, and the share of time it waits for batches; the first batch is excluded."""
    profiler = QuietProfiler()
    model = EmulatorModule(data.scene, frames=FRAMES, unroll=UNROLL, processor=UNet(width=32, perceptron=(32,)))
    trainer = Trainer(
        max_steps=steps,
        profiler=profiler,
        precision="bf16-mixed",
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        limit_val_batches=0,
        gradient_clip_val=1.0,
        devices=1,
    )
    trainer.fit(model, datamodule=data)
    waits = profiler.recorded_durations[WAITING][1:]
    work = profiler.recorded_durations["run_training_batch"][1:]
    total = sum(waits) + sum(work)
    return {
        "windows_per_second": data.batch_size * len(work) / total,
        "median_step_s": statistics.median(work),
        "waiting_share": sum(waits) / total,
        "longest_wait_s": max(waits),
    }


def measure(data: TrajectoryDataModule, steps: int) -> dict[str, Any]:
    """Both measurements for one source of data."""
    rates = buffer_rate(data)
    return {
        "data": data.description,
        "buffer_windows_per_second": {
            "median": statistics.median(rates),
            "least": min(rates),
            "most": max(rates),
        },
        "training": training_rate(data, steps),
    }


def main() -> None:
    """Measures, prints a line per source, and writes JSON with --json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60, help="training steps per source (default: 60)")
    parser.add_argument("--name", default="goop", help="embedded dataset (default: goop)")
    parser.add_argument("--path", help="measure this recorded dataset instead")
    parser.add_argument("--family")
    parser.add_argument("--gravity", type=float, nargs="+")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    common: dict[str, Any] = {
        "horizon": FRAMES * UNROLL, "batch_size": BATCH, "passes": PASSES, "emphasis": EMPHASIS,
    }  # fmt: skip
    if arguments.path:
        sources = [{"path": arguments.path, "family": arguments.family, "gravity": arguments.gravity}]
    else:
        sources = [{"name": arguments.name}, {"name": arguments.name, "source": "simulate"}]
    processor = f"CPU, {counted(torch.get_num_threads(), 'thread')}"
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else processor
    rows = [measure(TrajectoryDataModule(**source, **common), arguments.steps) for source in sources]
    sys.stdout.write(f"{device}; batch {BATCH}, {FRAMES} x {UNROLL} frames, {arguments.steps} steps\n")
    for row in rows:
        buffer, training = row["buffer_windows_per_second"], row["training"]
        sys.stdout.write(
            f"{row['data']}: the buffer gives {buffer['median']:.0f} ({buffer['least']:.0f}-{buffer['most']:.0f}) "
            f"windows/s, training takes {training['windows_per_second']:.1f}, waits {training['waiting_share']:.2%} of "
            f"its time, {training['longest_wait_s']:.3f} s at most\n"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps({"device": device, "sources": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
