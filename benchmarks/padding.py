"""Share of padding in training batches: padded to the buffer's largest scene, to the batch's, and with buckets.

    python benchmarks/padding.py --data FOLDER --batch_size 8 --buckets 1 4 16 64

The windows are those that a training draws; only their sizes are read, nothing is trained.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from nmpm.data.format import Split, read_metadata
from nmpm.data.loading.window_plan import WindowPlan

BATCHES = 400


def main() -> None:
    """Print a row for each way to pad."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of a dataset in the native layout")
    parser.add_argument("--split", default="train")
    parser.add_argument("--batch_size", type=int, default=8)
    parser.add_argument("--buffer_size", type=int, default=16)
    parser.add_argument("--buckets", type=int, nargs="+", default=[1, 4, 16, 64])
    chosen = parser.parse_args()
    split, moving = Split(chosen.data / f"{chosen.split}.h5"), read_metadata(chosen.data).moving_types
    sizes = [int(np.isin(split.particle_type(index), moving).sum()) for index in range(len(split))]
    frames = tuple(map(split.frames, range(len(split))))
    plan = WindowPlan(frames, 34, chosen.batch_size, chosen.buffer_size, passes=1.0, seed=0)
    rows = [
        f"{len(sizes)} trajectories of {min(sizes)} to {max(sizes)} particles, batches of {chosen.batch_size}",
        "padded to            particles per real one",
        f"largest of buffer    {cost(plan, sizes, of_buffer=True):.3f}",
        *(f"batch, bucket {bucket:>4}   {cost(replace(plan, bucket=bucket), sizes):.3f}" for bucket in chosen.buckets),
    ]
    sys.stdout.write("\n".join(rows) + "\n")


def cost(plan: WindowPlan, sizes: list[int], of_buffer: bool = False) -> float:
    """Particles in the batches' tensors over real ones."""
    padded = real = 0
    for index in range(BATCHES):
        bucket = plan.bucket_of(index, 1)
        windows = [window for own in bucket for window in plan.batch(own, 0, 1)]
        batch = plan.deal(bucket, windows, [sizes[trajectory] for trajectory, _ in windows])[index - bucket.start]
        own = [sizes[trajectory] for trajectory, _ in batch]
        members = plan.members(plan.locate(index, 1)[0])
        padded += len(own) * (max(sizes[trajectory] for trajectory in members) if of_buffer else max(own))
        real += sum(own)
    return padded / real


if __name__ == "__main__":
    main()
