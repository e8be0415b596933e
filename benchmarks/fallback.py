"""Price and error of rollouts that a simulator continues, beside the emulator alone and the simulator's own restart.

    python benchmarks/fallback.py waterramps ramps --scenes 8

For each test scene the emulator predicts until it is no longer trusted; the simulator goes on from there. *Restart* is
the simulator from the recorded state at that frame, which lacks strain and pressure likewise. Errors are those of
the frames that follow, times those of one core.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nmpm.data.format import Split, read_metadata
from nmpm.data.recordings import EvaluationLoader, SplitRecordings
from nmpm.evaluation.prediction_errors import field_error
from nmpm.particles import Window
from nmpm.scene import Reading, Scene
from nmpm.zoo import Pretrained, load_model
from nmpm.zoo.fallback import fitting_preset, predict_trusted, simulate_on
from nmpm.zoo.measures.scenes import simulator_of

COLUMNS = ("MSE ×10⁻³", "field, mean", "field, last")


def main(words: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("data", type=Path, help="folder of its data, from nmpm simulate")
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--at", type=int, help="frame at which the simulator takes over (default: the last trusted)")
    options = parser.parse_args(words)
    torch.set_num_threads(1)
    model = load_model(options.model)
    scenes = islice(windows(options.data / "test.h5", model), options.scenes)
    rows = [row for window in scenes if (row := measured(model, window, options.at)) is not None]
    if not rows:
        sys.stdout.write("no scene is lost\n")
        return
    sys.stdout.write(
        f"{len(rows)} of {options.scenes} scenes are lost, at frame {mean(rows, 'frame'):.0f} on average\n"
    )
    sys.stdout.write(f"ms a frame: emulator {mean(rows, 'emulator_ms'):.2f}, watched {mean(rows, 'watched_ms'):.2f},")
    sys.stdout.write(f" simulator {mean(rows, 'simulator_ms'):.2f}\n{'':<12}" + "".join(f"{c:>14}" for c in COLUMNS))
    for name in ("emulator", "fallback", "restart"):
        figures = np.mean([row[name] for row in rows], axis=0)
        sys.stdout.write(f"\n{name:<12}" + "".join(f"{figure:14.3f}" for figure in figures))
    sys.stdout.write("\n")


def windows(file: Path, model: Pretrained) -> Iterator[Window]:
    """The scenes of a split, one at a time."""
    recordings = SplitRecordings(Split(file), read_metadata(file.parent, "deepmind"), Reading(model.scene))
    yield from EvaluationLoader(recordings, 1)


def mean(rows: list[dict[str, float | list[float]]], name: str) -> float:
    """The mean of a column."""
    return float(np.mean([row[name] for row in rows]))


def measured(model: Pretrained, window: Window, at: int | None) -> dict[str, float | list[float]] | None:
    """Errors and times of one scene; None if it is trusted to its end."""
    scene, state, target = model.scene, window.initial, window.target
    preset, frames = fitting_preset(scene, state, simulator_of(model)), target.shape[1]
    begun = time.process_time()
    alone = model.rollout(state, frames)
    single = time.process_time() - begun
    trusted = predict_trusted(model.emulator, model.trust, state, frames)
    watched, last = time.process_time() - begun - single, at or int(trusted.trusted[0])
    if last in (0, frames):
        return None
    path = torch.cat([state.position[:, None], alone], dim=1)
    true_path = torch.cat([state.position[:, None], target], dim=1)
    after = {"emulator": alone[0, last:]}
    begun = time.process_time()
    for name, positions in (("fallback", path), ("restart", true_path)):
        start = state.with_motion(positions[:, last], positions[:, last] - positions[:, last - 1])
        after[name] = simulate_on(scene, start, preset, frames - last)
    simulating = (time.process_time() - begun) / 2 / (frames - last)
    times = {
        "emulator_ms": single / frames,
        "watched_ms": watched / trusted.position.shape[1],
        "simulator_ms": simulating,
    }
    errors = {name: error(scene, window, made, target[0, last:]) for name, made in after.items()}
    return {"frame": last, **{name: 1e3 * value for name, value in times.items()}, **errors}


def error(scene: Scene, window: Window, made: Tensor, truth: Tensor) -> list[float]:
    """Figures of `COLUMNS` of positions (T, N, D)."""
    material = window.material[0]
    squared = 1e3 * (made - truth).double().square().mean()
    pairs = ((made, truth), (made[-1:], truth[-1:]))
    return [float(squared), *(field_error(scene, ours.double(), right.double(), material) for ours, right in pairs)]


if __name__ == "__main__":
    main()
