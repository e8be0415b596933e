"""Does a model fail on what it has not seen, or on what it cannot predict? Scenes of its training beside test scenes.

python benchmarks/seen_scenes.py waterdrop-xl FOLDER --scenes 8 --starts 0 200 400 --json seen_scenes.json
python benchmarks/seen_scenes.py variablegravity FOLDER --splits train --forms rest_speed=0.005 rest_speed=0 free

Rows: scenes of the training and of the test split of the dataset in FOLDER, rolled out from several recorded frames, by
the model as it is and with each form of its constraints (`settled_shape.py`). Columns: MSE × 10³ of the positions after
so many frames and over all of them, with a 95% interval (bootstrap over scenes), or over the first form's by a paired
bootstrap; the kinetic energy in the second half of the frames over the recording's. Where both splits have the same
error, more trajectories gain nothing; where rollouts from late frames are right and those from frame 0 are not, the
motion is learned and the error is carried along from earlier frames.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from itertools import islice, product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from settled_shape import held_to, ratio
from timing import add_device_option, make_parser, write_json

from nmpm._support.progress import progress_bar
from nmpm.data.format import Split, read_metadata, split_paths
from nmpm.data.loading.evaluation import EvaluationLoader
from nmpm.data.loading.recording import SplitRecordings
from nmpm.emulator import Emulator, rollout
from nmpm.evaluation.bootstrap import interval
from nmpm.particles import Window
from nmpm.zoo import load_model
from nmpm.zoo.pretrained import Pretrained

Array = NDArray[np.float64]
AS_IT_IS = "as it is"


def read_scenes(model: Pretrained, folder: Path, split: str) -> EvaluationLoader:
    """The whole trajectories of a split, one at a time."""
    recorded = Split(split_paths(folder)[split])
    return EvaluationLoader(SplitRecordings(recorded, read_metadata(folder, "deepmind"), model.scene), batch_size=1)


def cut(window: Window, start: int, frames: int) -> Window:
    """The frames of a window from `start` on, with so many to predict."""
    return dataclasses.replace(window, frames=window.frames[:, start : start + frames + 2])


def measure_scene(emulator: Emulator, window: Window) -> tuple[Array, Array]:
    """Squared error (frames,) of a rollout, and (2,) late kinetic energies, of it and of the recording."""
    moving = window.mask[0]
    truth = window.target[0, :, moving].double().numpy()
    predicted = rollout(emulator, window.initial.to(emulator.device), len(truth))[0].cpu()[:, moving].double().numpy()
    energies = [np.mean(np.diff(path[len(path) // 2 :], axis=0) ** 2) for path in (predicted, truth)]
    return np.mean((predicted - truth) ** 2, axis=(1, 2)), np.array(energies)


def measure(emulator: Emulator, windows: Sequence[Window], what: str) -> tuple[Array, Array]:
    """Of each scene, see `measure_scene`: (scenes, frames) and (scenes, 2); with a progress bar."""
    found = []
    with progress_bar(what, len(windows)) as advance:
        for window in windows:
            found.append(measure_scene(emulator, window))
            advance()
    errors, energies = zip(*found, strict=True)
    return np.array(errors), np.array(energies)


def format_row(errors: Array, energies: Array, after: Sequence[int], first: Array | None) -> str:
    """The columns of a row, from what `measure` returns; `first` are the errors that those of all frames are over."""
    cells = [f"{1e3 * errors[:, frame - 1].mean():.3g}" if frame <= errors.shape[1] else "" for frame in after]
    full = 1e3 * errors.mean(1)
    spread = "{:.3g}–{:.3g}".format(*interval(list(full))) if first is None else ratio(full, 1e3 * first.mean(1))
    predicted, recorded = energies.sum(0)
    return " | ".join([*cells, f"{full.mean():.3g}, {spread}", f"{predicted / recorded:.2f}"])


def main() -> None:
    """Measure, and print one line for each split and first frame."""
    parser = make_parser(__doc__)
    parser.add_argument("model", help="of the zoo, or a run's folder")
    parser.add_argument("folder", type=Path, help="the dataset of its training: train.h5, test.h5, metadata.json")
    parser.add_argument("--scenes", type=int, default=8, help="of each split")
    parser.add_argument("--splits", nargs="+", default=["train", "test"])
    parser.add_argument(
        "--forms", nargs="+", default=[], help="of the constraints, e.g. rest_speed=0.005; free for none"
    )
    parser.add_argument("--starts", nargs="+", type=int, default=[0], help="recorded frames to roll out from")
    parser.add_argument("--frames", type=int, default=200, help="of the rollouts that start later than frame 0")
    parser.add_argument("--after", nargs="+", type=int, default=[32, 100, 200], help="frames of the columns")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    add_device_option(parser)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    model = load_model(chosen.model, chosen.device)
    forms = {AS_IT_IS: model.emulator} | {form: held_to(model.emulator, form) for form in chosen.forms}
    heads = " | ".join(f"after {frame}" for frame in chosen.after)
    sys.stdout.write(f"| split | from frame | constraints | {heads} | all | energy |\n")
    sys.stdout.write(f"|---|---:|---|{'---:|' * (len(chosen.after) + 2)}\n")
    found = {}
    for split, start in product(chosen.splits, chosen.starts):
        scenes = list(islice(read_scenes(model, chosen.folder, split), chosen.scenes))
        frames = min(window.target.shape[1] for window in scenes) if start == 0 else chosen.frames
        windows, first = [cut(window, start, frames) for window in scenes], None
        for form, emulator in forms.items():
            errors, energies = measure(emulator, windows, f"{split}, from frame {start}, {form}")
            columns = format_row(errors, energies, chosen.after, first)
            sys.stdout.write(f"| {split} | {start} | {form} | {columns} |\n")
            found[f"{split}, {start}, {form}"] = {"errors": errors.mean(1).tolist(), "energies": energies.tolist()}
            first = errors if first is None else first
    write_json(chosen.json, found)


if __name__ == "__main__":
    main()
