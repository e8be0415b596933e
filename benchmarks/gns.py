"""Train a particle-graph network (GNS) on an embedded dataset, as a baseline for `nmpm trade`.

    python benchmarks/gns.py goop --minutes 2 5 10 --out runs/gns
    nmpm trade goop --config benchmarks/trade/goop.yaml --models goop runs/gns/minutes-*

Minutes are CPU time of one thread, of training alone. The simulator is written at each of them, with its validation
loss so far, so that `nmpm trade` shows error against training time, and names what has not converged. After an
interruption the same command goes on from the last of them, or from the last validation between them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from nmpm.data.catalog import catalog, ensure
from nmpm.data.format import Split, read_metadata
from nmpm.data.loading.recording import Recording, SplitRecordings
from nmpm.data.scene_inference import infer_scene
from nmpm.evaluation.gns import (
    GraphRecipe,
    GraphTrainer,
    GraphTraining,
    TrainedGraph,
    read_progress,
    validation_loss,
    write_graph,
    write_progress,
)
from nmpm.scene import Scene

CHECKS = 24
"""Validation losses per training, beside those of the written simulators."""


def main() -> None:
    """Train and write what the command line asks for."""
    chosen = _parser().parse_args()
    torch.manual_seed(chosen.seed)
    folder = ensure(chosen.dataset, {"train": chosen.trajectories, "valid": 2, "test": 0})
    scene = infer_scene(folder)
    training, validation = (_recordings(folder, scene, split) for split in ("train", "valid"))
    simulator = GraphRecipe(scene, width=chosen.width).build()
    settings = GraphTraining(60 * max(chosen.minutes), chosen.noise, chosen.batch, chosen.rate, seed=chosen.seed)
    trainer, curve, stored = GraphTrainer(simulator, training, settings), [], chosen.out / "training.safetensors"
    if stored.is_file():
        state, curve = read_progress(stored)
        trainer.load_state_dict(state)
    checks = {max(chosen.minutes) * (i + 1) / CHECKS for i in range(CHECKS)}
    due = sorted(minutes for minutes in {*chosen.minutes, *checks} if 60 * minutes > trainer.spent)
    while not trainer.done:
        trainer.step()
        while due and trainer.spent >= 60 * due[0]:
            minutes = due.pop(0)
            curve.append((minutes, validation_loss(simulator, validation, chosen.noise)))
            sys.stdout.write(f"{minutes:.3g} min, {trainer.steps} steps: loss {curve[-1][1]:.4f}\n")
            sys.stdout.flush()
            if minutes in chosen.minutes:
                graph = TrainedGraph(simulator, minutes, trainer.steps, tuple(curve))
                write_graph(chosen.out / f"minutes-{minutes:g}", graph)
            write_progress(stored, trainer.state_dict(), curve)


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
