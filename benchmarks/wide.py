"""A model trained in a square box, rolled out in one twice as wide without retraining, beside the square's error.

python benchmarks/wide.py runs/parts/unet runs/parts/convnext --scenes 10
python benchmarks/wide.py --zoo goop

Scenes of both boxes are simulated by the preset that made the training data: in the wide one there are twice as many
particles at most, in up to twice as many blocks. Errors are mean squared distances × 10⁻³ over frames 1 … h.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from nmpm.data.format import Trajectory
from nmpm.data.generate import derive_seed, preset_metadata
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import RecordingReader
from nmpm.data.progress import progress_bar
from nmpm.emulator.model import Emulator
from nmpm.emulator.rollouts import rollout
from nmpm.evaluation.comparison import Comparison
from nmpm.metrics import MSE
from nmpm.sim import Preset, load_preset
from nmpm.training import EmulatorModule
from nmpm.zoo import Zoo

HORIZONS = (32, 100)


def error(emulator: Emulator, preset: Preset, seeds: list[int], workers: int) -> dict[str, float]:
    """Errors of the emulator on scenes of a preset, in the box of that preset."""
    scene = preset.scene
    emulator = emulator.over(scene).eval()
    reader = RecordingReader(preset_metadata(preset), scene)
    comparison = Comparison(scene, [MSE(HORIZONS)])
    with ThreadPoolExecutor(workers) as pool, progress_bar(f"{preset.name} box", len(seeds)) as advance:
        for made in pool.map(preset.simulate, seeds):
            window = collate([reader.recording(Trajectory(made.position, made.particle_type), preset.name)], scene)
            comparison.update(window, rollout(emulator, window.initial, window.target.shape[1]))
            advance()
    return {name: 1e3 * float(value) for name, value in comparison.compute().items()}


def trained(run: Path) -> Emulator:
    """The best checkpoint of a run."""
    module = EmulatorModule.load_from_checkpoint(run / "checkpoints" / "best.ckpt", weights_only=True)
    return module.emulator.cpu()


def main() -> None:
    """Simulate, roll out, and print a line per model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--zoo", nargs="+", default=[], help="models of the zoo")
    parser.add_argument("--preset", default="goop")
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    chosen = parser.parse_args()
    preset = load_preset(chosen.preset)
    seeds = [derive_seed(chosen.seed, index) for index in range(chosen.scenes)]
    models = {run.name: trained(run) for run in chosen.runs} | {name: Zoo.load(name).emulator for name in chosen.zoo}
    for name, emulator in models.items():
        for kind in (preset, dataclasses.replace(preset.widened(2), name="wide")):
            with torch.no_grad():
                errors = error(emulator, kind, seeds, chosen.workers)
            figures = "  ".join(f"{key} {value:.4g}" for key, value in errors.items())
            sys.stdout.write(f"{name:<20}{kind.name:<8}{figures}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
