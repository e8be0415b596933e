"""The same weights at several points of time and error: commit lengths, and ensembles over sub-cell shifts of the grid.

    python benchmarks/run_time_knob.py goop waterramps --scenes 8

A commit length j takes only the first j of the m frames of each bundle, so that a rollout needs m / j times as many
calls. An ensemble predicts each bundle on n grids that are shifted by a quarter of a cell, and goes on from the mean.
A knob is worth having if paying more buys a smaller error. Times are CPU time of one thread, over the model's own.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm.data.catalog import ensure, find_simulated
from nmpm.emulator import Emulator
from nmpm.evaluation.trade import Scenes, read_scenes
from nmpm.particles import Particles
from nmpm.zoo import load_model

QUARTERS = {
    1: ((0.0, 0.0),),
    2: ((-0.25, -0.25), (0.25, 0.25)),
    4: ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)),
}
"""Shifts of the grids of an ensemble, in cells."""


def main() -> None:
    """Print one table for each model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="of the zoo")
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--commit", type=int, nargs="*", default=[6, 4, 2], help="commit lengths below m")
    parser.add_argument("--members", type=int, nargs="*", default=[2, 4], choices=sorted(QUARTERS), help="of ensembles")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    for name in chosen.models:
        model = load_model(name)
        scenes = find_scenes(str(model.preset), chosen.scenes)
        settings = [(1, model.emulator.frames), *((1, j) for j in chosen.commit if j < model.emulator.frames)]
        measure(name, model.emulator, scenes, settings + [(n, model.emulator.frames) for n in chosen.members])


def measure(name: str, emulator: Emulator, scenes: Scenes, settings: Sequence[tuple[int, int]]) -> None:
    """Measure settings (members, commit), all in turn on each scene; the first is the model's own."""
    torch.manual_seed(0)
    rows = {setting: ([], []) for setting in settings}
    forms = {members: [shifted(emulator, shift) for shift in QUARTERS[members]] for members, _ in settings}
    for index in range(len(scenes)):
        window = scenes.window([index])
        for members, commit in settings:
            start = time.thread_time()
            path = knob_rollout(forms[members], window.initial, window.target.shape[1], commit)
            spent = time.thread_time() - start
            error = (path - window.target).square().mean((0, 2, 3))
            rows[members, commit][0].append(torch.stack([error[:100].mean(), error.mean()]))
            rows[members, commit][1].append(spent)
    own, least = torch.stack(rows[settings[0]][0]), torch.tensor(rows[settings[0]][1])
    sys.stdout.write(f"\n{name}, {len(scenes)} scenes\n\n| members | commit | time | MSE@100 | MSE | better in |\n")
    sys.stdout.write("|---:|---:|---:|---:|---:|---:|\n")
    for (members, commit), (errors, times) in rows.items():
        found = torch.stack(errors)
        ratio = float((torch.tensor(times) / least).median())
        early, full = (1e3 * found.mean(0)).tolist()
        better = int((found[:, 1] < own[:, 1]).sum())
        sys.stdout.write(
            f"| {members} | {commit} | {ratio:.2f} | {early:.3g} | {full:.3g} | {better} of {len(found)} |\n"
        )
        sys.stdout.flush()


def shifted(emulator: Emulator, shift: Sequence[float]) -> Emulator:
    """The same weights on a grid that is shifted by a part of a cell along each axis."""
    if not any(shift):
        return emulator
    scene = emulator.scene
    sides = zip(scene.domain, emulator.grid.spacing, shift, strict=True)
    domain = tuple((low + part * h, high + part * h) for (low, high), h, part in sides)
    return emulator.over(dataclasses.replace(scene, domain=domain)).eval()


@torch.no_grad()
def knob_rollout(emulators: Sequence[Emulator], particles: Particles, frames: int, commit: int) -> Tensor:
    """Positions (B, frames, N, D): the mean of the emulators' paths, of which each bundle gives `commit` frames."""
    contexts = [emulator.context(particles) for emulator in emulators]
    parts, made = [], 0
    while made < frames:
        bundles = [emulator(particles, context) for emulator, context in zip(emulators, contexts, strict=True)]
        path = torch.stack([bundle.position for bundle in bundles]).mean(0)[:, :commit]
        if commit == emulators[0].frames:
            velocity = torch.stack([bundle.velocity for bundle in bundles]).mean(0)
        else:
            velocity = last_step(path, particles)
        particles = particles.with_motion(path[:, -1], velocity)
        parts.append(path)
        made += commit
    return torch.cat(parts, dim=1)[:, :frames]


def last_step(path: Tensor, particles: Particles) -> Tensor:
    """(B, N, D) step to the last frame of a path (B, T, N, D), from the state before it where it has one frame."""
    return path[:, -1] - (path[:, -2] if path.shape[1] > 1 else particles.position)


def find_scenes(preset: str, count: int) -> Scenes:
    """The first test scenes of a preset, simulated on first use."""
    folder = find_simulated(preset, count) or ensure(preset, {"train": 0, "valid": 0, "test": count})
    return read_scenes(preset, folder, count)


if __name__ == "__main__":
    main()
