"""Errors of models in a box twice as wide as the one that they were trained in, beside those in their own.

python benchmarks/wider_box.py runs/parts/unet runs/parts/convnext --scenes 10
python benchmarks/wider_box.py --zoo goop

Scenes of both boxes are simulated by the preset that made the training data; the wide one holds up to twice as many
particles in up to twice as many blocks. Nothing is retrained. Errors are mean squared distances × 10⁻³ over frames 1
to h.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from timing import add_device_option, make_parser

from nmpm.data.format import Trajectory
from nmpm.data.generate import derive_seed, preset_metadata
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import RecordingReader
from nmpm.data.progress import progress_bar
from nmpm.emulator import Emulator, rollout
from nmpm.evaluation.comparison import Comparison
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.sim import Preset, load_preset
from nmpm.training import EmulatorModule
from nmpm.zoo import Zoo

HORIZONS = (32, 100)


def simulate_windows(preset: Preset, seed: int, scenes: int, workers: int) -> Iterator[Window]:
    """Whole trajectories of a preset, one scene each."""
    reader = RecordingReader(preset_metadata(preset), preset.scene)
    seeds = [derive_seed(seed, index) for index in range(scenes)]
    with ThreadPoolExecutor(workers) as pool, progress_bar(f"{preset.name} box", scenes) as advance:
        for made in pool.map(preset.simulate, seeds):
            recording = reader.recording(Trajectory(made.position, made.particle_type), preset.name)
            yield collate([recording], preset.scene)
            advance()


@torch.no_grad()
def measure_errors(emulator: Emulator, preset: Preset, windows: Iterable[Window]) -> dict[str, float]:
    """Errors × 10⁻³ of the emulator on trajectories of a preset, in that preset's box."""
    emulator = emulator.over(preset.scene).eval()
    comparison = Comparison(preset.scene, [MSE(HORIZONS)])
    for window in windows:
        predicted = rollout(emulator, window.initial.to(emulator.device), window.target.shape[1])
        comparison.update(window, predicted.cpu())
    return {name: 1e3 * float(value) for name, value in comparison.compute().items()}


def load_best(run: Path) -> Emulator:
    """The best checkpoint of a run."""
    path = run / "checkpoints" / "best.ckpt"
    return EmulatorModule.load_from_checkpoint(path, map_location="cpu", weights_only=True).emulator


def main() -> None:
    """Simulate, roll out, and print a line per model and box."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--zoo", nargs="+", default=[], help="models of the zoo")
    parser.add_argument("--preset", default="goop")
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--frames", type=int, help="of each scene (default: the preset's)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    add_device_option(parser)
    chosen = parser.parse_args()
    preset = load_preset(chosen.preset)
    preset = preset.with_frames(chosen.frames or preset.frames)
    models = {run.name: load_best(run) for run in chosen.runs}
    models |= {name: Zoo.load(name).emulator for name in chosen.zoo}
    for name, emulator in models.items():
        for kind in (preset, dataclasses.replace(preset.widened(2), name="wide")):
            windows = simulate_windows(kind, chosen.seed, chosen.scenes, chosen.workers)
            errors = measure_errors(emulator.to(chosen.device), kind, windows)
            figures = "  ".join(f"{key} {value:.4g}" for key, value in errors.items())
            sys.stdout.write(f"{name:<20}{kind.name:<8}{figures}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
