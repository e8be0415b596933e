"""What positions and velocities leave unknown: a simulator restarted from them in mid-trajectory, beside a model.

python benchmarks/hidden_state.py sandramps --scenes 6 --starts 0 8 16 40 100 200 --json hidden.json

The simulator's particles also carry strain and the velocity around them. At each start frame of a test scene it goes on
from what the model is given, positions and the velocity of the last frame, with material free of strain. Columns: mean
squared distance × 10⁶ from the trajectory after so many frames, of the restarted simulator and of the model, averaged
over these frames. At frame 0 scenes are free of strain, so that the simulator's error is zero. Scenes that cannot be
restarted, as a particle is inside an obstacle, are left out of a row; a scene's own simulation must be deterministic.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from timing import make_parser, write_json

from nmpm.emulator import rollout
from nmpm.errors import DataError
from nmpm.particles import Window
from nmpm.sim import InitialState, Preset
from nmpm.zoo import Zoo
from nmpm.zoo.measures.scenes import iterate_test_scenes, simulation_of
from nmpm.zoo.pretrained import Pretrained

Array = NDArray[Any]
_INSIDE = 1e-7
"""Share of the box by which restarted particles keep from its sides: frames are stored in float32."""


def restart(preset: Preset, drawn: InitialState, frames: Array, ahead: int) -> Array | None:
    """(ahead, N, D) positions simulated from two frames (2, N, D) on; None where the simulator does not take them.

    Args:
        preset: The simulator.
        drawn: The trajectory's own initial state, which gives materials, obstacles and gravity.
        frames: The last two known frames.
        ahead: Frames to simulate.
    """
    gravity = np.array(preset.scene.gravity if drawn.gravity is None else drawn.gravity)
    late = 0.5 * (1 - 1 / preset.substeps)  # of the last frame: how far its mean velocity lags behind that at its end
    velocity = (frames[1] - frames[0]) / preset.frame_dt + late * preset.frame_dt * gravity
    low, high = np.array(preset.scene.bounds).T
    position = np.clip(frames[1], low + _INSIDE * (high - low), high - _INSIDE * (high - low))
    start = InitialState(position, velocity, drawn.gravity, drawn.counts, drawn.obstacles)
    try:
        return preset.simulate_from(start, ahead).position[1:, : len(position)]
    except DataError:
        return None


def predict(model: Pretrained, window: Window, start: int, ahead: int) -> Array:
    """(ahead, N, D) positions predicted from two frames of a window of one scene, the first of which is `start`."""
    known = Window(
        window.frames[:, start : start + 2], window.material, window.mask, window.obstacle, window.obstacle_mask,
        window.gravity,
    )  # fmt: skip
    with torch.autocast("cpu", torch.bfloat16):
        return np.asarray(rollout(model.emulator, known.initial, ahead)[0])


def measure(model: Pretrained, chosen: Namespace) -> Iterator[dict[str, float]]:
    """Errors × 10⁶ of each scene and start frame, after each of the chosen numbers of frames."""
    preset, request = simulation_of(model)
    ahead = max(chosen.frames)
    scenes = iterate_test_scenes(model, max(chosen.starts) + ahead, chosen.data)
    for index, window in zip(range(chosen.scenes), scenes, strict=False):
        drawn = preset.draw(request.trajectory_seed("test", index))
        frames = window.frames[0].double().numpy()
        for start in chosen.starts:
            again = restart(preset, drawn, frames[start : start + 2], ahead)
            if again is None:
                continue
            true = frames[start + 2 : start + 2 + ahead]
            paths = {"simulator": again, "model": predict(model, window, start, ahead)}
            errors = {name: 1e6 * ((path - true) ** 2).mean((1, 2)) for name, path in paths.items()}
            of_frames = {f"{name} at {n}": float(own[:n].mean()) for name, own in errors.items() for n in chosen.frames}
            yield {"start": start, "scene": index, **of_frames}


def main() -> None:
    """Measure, and print one line for each start frame."""
    parser = make_parser(__doc__)
    parser.add_argument("model", help="of the zoo, trained on simulated data of a preset without fields")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--starts", nargs="+", type=int, default=[0, 8, 16, 40, 100, 200])
    parser.add_argument("--frames", nargs="+", type=int, default=[8, 32])
    parser.add_argument("--data", type=Path, help="folder of the dataset, which spares the simulation of the scenes")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    rows = list(measure(Zoo.load(chosen.model), chosen))
    names = [name for name in rows[0] if name not in ("start", "scene")]
    sys.stdout.write(f"| start | scenes | {' | '.join(names)} |\n|{'---|' * (len(names) + 2)}\n")
    for start in chosen.starts:
        own = [row for row in rows if row["start"] == start]
        means = [f"{np.mean([row[name] for row in own]):.3g}" for name in names] if own else ["–"] * len(names)
        sys.stdout.write(f"| {start} | {len(own)} | {' | '.join(means)} |\n")
    write_json(chosen.json, {"rows": rows})


if __name__ == "__main__":
    main()
