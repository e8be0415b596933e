"""Train a particle-graph network (GNS) on an embedded dataset, as a baseline for `nmpm trade`.

    python benchmarks/gns.py goop --minutes 2 5 10 --out runs/gns
    nmpm trade goop --config benchmarks/trade/goop.yaml --models goop runs/gns/minutes-*

Minutes are CPU time of one thread, of training alone. The simulator is written at each of them, with its validation
loss so far, so that `nmpm trade` shows error against training time, and names what has not converged.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import torch

from nmpm.data.catalog import catalog, ensure
from nmpm.data.format import Split, read_metadata
from nmpm.data.loading.recording import Recording, SplitRecordings
from nmpm.data.scene_inference import infer_scene
from nmpm.evaluation.gns import GraphRecipe, GraphTraining, TrainedGraph, train, validation_loss, write_graph
from nmpm.scene import Scene

CHECKS = 8
"""Validation losses per training, beside those of the written simulators."""


def main() -> None:
    """Train and write what the command line asks for."""
    chosen = _parser().parse_args()
    torch.manual_seed(chosen.seed)
    counts = {"train": chosen.trajectories, "valid": 2, "test": 0}
    folder = ensure(chosen.dataset, counts)
    scene = infer_scene(folder)
    training, validation = (_recordings(folder, scene, split) for split in ("train", "valid"))
    simulator = GraphRecipe(scene, width=chosen.width).build()
    settings = GraphTraining(60 * max(chosen.minutes), chosen.noise, chosen.batch, chosen.rate, seed=chosen.seed)
    due = sorted({*chosen.minutes, *(max(chosen.minutes) * (i + 1) / CHECKS for i in range(CHECKS))})
    curve: list[tuple[float, float]] = []
    start = time.perf_counter()
    for step, seconds in enumerate(train(simulator, training, settings), 1):
        while due and seconds >= 60 * due[0]:
            minutes = due.pop(0)
            curve.append((minutes, validation_loss(simulator, validation, chosen.noise)))
            wall = (time.perf_counter() - start) / 60
            sys.stdout.write(f"{minutes:.3g} min ({wall:.3g} by the wall), {step} steps: loss {curve[-1][1]:.4f}\n")
            sys.stdout.flush()
            if minutes in chosen.minutes:
                write_graph(chosen.out / f"minutes-{minutes:g}", TrainedGraph(simulator, minutes, step, tuple(curve)))


def _recordings(folder: Path, scene: Scene, split: str) -> list[Recording]:
    recordings = SplitRecordings(Split(folder / f"{split}.h5"), read_metadata(folder), scene)
    return [recordings[index] for index in range(len(recordings))]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", choices=catalog())
    parser.add_argument(
        "--minutes", type=float, nargs="+", default=[2.0, 5.0, 10.0], help="written then; the last ends"
    )
    parser.add_argument("--trajectories", type=int, default=40, help="to train on")
    parser.add_argument("--width", type=int, default=32, help="of latent vectors; the paper's is 128")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--noise", type=float, default=6.7e-4, help="of the last velocity, in length per frame")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/gns"))
    return parser


if __name__ == "__main__":
    main()
