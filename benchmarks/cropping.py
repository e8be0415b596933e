"""What cropping training windows to where particles are could save, at most: cells of the crops over cells of the grid.

    python benchmarks/cropping.py goop=FOLDER waterramps=FOLDER

Reads positions of training windows, trains nothing. A crop holds every cell that a particle of the window reads in any
of its frames. "exact" adds what the network sees from there, so that the loss is that of the whole grid; "bare" adds
nothing, and the network meets walls of zeros that are not there. Windows of a batch need crops of one size.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from nmpm.data.format import Split, read_metadata
from nmpm.data.loading.window_plan import WindowPlan
from nmpm.emulator.runtimes.grid_crops import Axis
from nmpm.zoo import Zoo

BATCHES = 50


def main() -> None:
    """Print a row for each dataset."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data", nargs="+", help="NAME=FOLDER: a model of the zoo, and the folder of its data")
    parser.add_argument("--batches", type=int, default=BATCHES)
    chosen = parser.parse_args()
    configs = Path(__file__).parent.parent / "configs"
    sys.stdout.write("dataset          grid        radius  batch  bare   exact\n")
    for pair in chosen.data:
        name, _, folder = pair.partition("=")
        options = yaml.safe_load((configs / f"{name}.yaml").read_text(encoding="utf-8"))
        frames = options["model"]["frames"] * options["model"]["unroll"]
        emulator, batch = Zoo.load(name).emulator, options["data"]["batch_size"]
        radius, shape = emulator.processor.radius, emulator.grid.shape
        boxes = read_boxes(Path(folder), emulator.scene.domain, shape, frames, batch, chosen.batches)
        shares = [
            share_of(boxes, [Axis(n, False, own, emulator.processor.alignment) for n in shape])
            for own in (0, max(shape) if radius is None else radius)
        ]
        grid = " x ".join(map(str, shape))
        sys.stdout.write(f"{name:<16} {grid:<11} {radius!s:>6}  {batch:>5}  {shares[0]:.2f}   {shares[1]:.2f}\n")
        sys.stdout.flush()


def read_boxes(
    folder: Path,
    domain: tuple[tuple[float, float], ...],
    shape: tuple[int, ...],
    frames: int,
    batch: int,
    batches: int,
) -> NDArray[np.int64]:
    """First and last cell of the particles of training windows along each axis, (batches, B, 2, D)."""
    split, metadata = Split(folder / "train.h5"), read_metadata(folder)
    lengths = tuple(map(split.frames, range(len(split))))
    plan = WindowPlan(lengths, frames + 2, batch, 8, passes=1.0, seed=0)
    low, high = np.array(domain).T
    cell = (high - low) / np.array(shape)
    boxes = []
    for index in range(batches):
        for trajectory, first in plan.batch(index, 0, 1):
            stored = split.read(trajectory, first, first + frames + 2)
            moving = np.isin(stored.particle_type, metadata.moving_types)
            cells = np.floor((stored.position[:, moving] - low) / cell).astype(np.int64)
            boxes.append((cells.min((0, 1)), cells.max((0, 1))))
    return np.array(boxes).reshape(batches, batch, 2, len(shape))


def share_of(boxes: NDArray[np.int64], axes: list[Axis]) -> float:
    """Mean over batches of the cells of a crop that suits all windows of the batch, over those of the grid."""
    lengths = []
    for axis, own in zip(axes, np.moveaxis(boxes, -1, 0), strict=True):
        needed = own[..., 1] - own[..., 0] + 1 + 2 * axis.halo
        aligned = -(-needed.max(-1) // axis.alignment) * axis.alignment
        lengths.append(np.minimum(aligned, axis.cells) / axis.cells)
    return float(np.prod(lengths, axis=0).mean())


if __name__ == "__main__":
    main()
