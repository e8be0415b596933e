"""Where the error of a full rollout begins: a model predicts the first frames, its simulator all that follow.

python benchmarks/hand_over.py waterramps --scenes 10 --frames 8 32 100 200 --json hand_over.json

Columns, MSE × 10³ over all frames of a test scene: *model, then simulator*, which goes on from the positions and the
velocity that the model predicted after so many frames; *simulator*, which does so from the trajectory's own, as a
restart forgets strain and local velocities (`hidden_state.py`). Where the first is close to the model's own full
rollout, what the model adds later hardly matters: the scene has carried its early errors away. Scenes in which a
restart fails, as a particle is inside an obstacle, are left out of all columns.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hidden_state import restart
from numpy.typing import NDArray
from timing import make_parser, write_json

from nmpm.sim import InitialState, Preset
from nmpm.zoo import Zoo
from nmpm.zoo.measures.scenes import iterate_test_scenes, simulation_of
from nmpm.zoo.pretrained import Pretrained

Array = NDArray[Any]


def hand_over(preset: Preset, drawn: InitialState, known: Array, total: int) -> Array | None:
    """(total, N, D) positions: the known first ones, and the simulator's from the last two of them on."""
    rest = restart(preset, drawn, known[-2:], total - len(known))
    return None if rest is None else np.concatenate([known, rest])


def measure(model: Pretrained, chosen: Namespace) -> Iterator[dict[str, Any]]:
    """MSE × 10³ of each scene by what predicted it."""
    preset, request = simulation_of(model)
    scenes = iterate_test_scenes(model, None, chosen.data)
    for index, window in zip(range(chosen.scenes), scenes, strict=False):
        drawn = preset.draw(request.trajectory_seed("test", index))
        truth = window.frames[0].double().numpy()
        predicted = model.rollout(window.initial, len(truth) - 2)[0].double().numpy()
        path = np.concatenate([truth[:2], predicted])
        found = {"model": path}
        for frames in chosen.frames:
            found[f"model, then simulator {frames}"] = hand_over(preset, drawn, path[: frames + 2], len(truth))
            found[f"simulator {frames}"] = hand_over(preset, drawn, truth[: frames + 2], len(truth))
        if all(own is not None for own in found.values()):
            yield {name: 1e3 * float(((own - truth)[2:] ** 2).mean()) for name, own in found.items()}


def main() -> None:
    """Measure, and print one line for each number of frames."""
    parser = make_parser(__doc__)
    parser.add_argument("model", help="of the zoo, trained on simulated data of a preset without fields")
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--frames", nargs="+", type=int, default=[8, 32, 100, 200], help="that the model predicts")
    parser.add_argument("--data", type=Path, help="folder of the dataset, which spares the simulation of the scenes")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    rows = list(measure(Zoo.load(chosen.model), chosen))
    if not rows:
        sys.exit("no scene could be restarted")
    means = {name: np.mean([row[name] for row in rows]) for name in rows[0]}
    sys.stdout.write(f"{len(rows)} scenes; the model alone: {means['model']:.3g}\n")
    sys.stdout.write("| frames | model, then simulator | simulator |\n|---:|---:|---:|\n")
    for frames in chosen.frames:
        both, own = means[f"model, then simulator {frames}"], means[f"simulator {frames}"]
        sys.stdout.write(f"| {frames} | {both:.3g} | {own:.3g} |\n")
    write_json(chosen.json, {"rows": rows})


if __name__ == "__main__":
    main()
