"""Draw rollouts of trained runs below each other, with the simulation that they predict on top.

python benchmarks/recipe_pictures.py before=runs/goop-before-0 default=runs/goop-0 --out goop.png [--scene 2]

Runs are folders of `nmpm fit` of the same dataset, each with the label of its row. The scene is one of the test split.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import torch
from recipes import Run, test_batches
from timing import make_parser

from nmpm.emulator import rollout
from nmpm.particles import Window
from nmpm.viz import LabelledTrajectories, write_snapshots


def main() -> None:
    """Roll each run out from the scene's start, and draw."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="+", metavar="LABEL=RUN")
    parser.add_argument("--out", type=Path, required=True, help="a PNG file")
    parser.add_argument("--scene", type=int, default=0, help="index in the test split (0)")
    chosen = parser.parse_args()
    runs = {label: Run(Path(path).resolve()) for label, _, path in (word.partition("=") for word in chosen.runs)}
    torch.set_num_threads(1)
    title = f"{next(iter(runs.values())).report['dataset']}: test scene {chosen.scene}"
    scene = test_scene(next(iter(runs.values())), chosen.scene)
    write_snapshots(dataclasses.replace(rolled_out(runs, scene), title=title), chosen.out)
    sys.stdout.write(f"wrote {chosen.out}\n")


def test_scene(run: Run, index: int) -> Window:
    """A window of one scene, in the order in which the test split is loaded."""
    scenes = [window.scenes(slice(row, row + 1)) for window in test_batches(run) for row in range(len(window.frames))]
    return scenes[index]


def rolled_out(runs: dict[str, Run], window: Window) -> LabelledTrajectories:
    """The simulation, and each run's rollout from its first two frames."""
    real = window.mask[0]
    rows = {"simulation": window.frames[0][:, real]}
    for label, run in runs.items():
        predicted = rollout(run.emulator, window.initial, window.target.shape[1])[0][:, real]
        rows[label] = torch.cat([rows["simulation"][:2], predicted])
    scene = next(iter(runs.values())).emulator.scene
    obstacle = window.obstacle[0, window.obstacle_mask[0]].numpy()
    positions = {label: row.numpy() for label, row in rows.items()}
    return LabelledTrajectories.from_scene(scene, positions, window.material[0, real].numpy(), obstacle)


if __name__ == "__main__":
    main()
