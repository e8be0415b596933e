"""A simulator's preset beside recorded trajectories, from their first two frames: how near it stays over time.

Usage: python benchmarks/against_recordings.py FOLDER PRESET [--splits test ...] [--as 8=goop ...]

    … against_recordings.py $NMPM_TEST_DATA/deepmind-waterdrop waterdrop --splits valid test
    … against_recordings.py $NMPM_TEST_DATA/taichi-elements-2d/mixed benchmarks/presets/taichi-mixed.yaml --as 8=goop

The recording's second frame starts ours, with the velocity that free fall from the first implies. PRESET is a shipped
name or a file; its blocks and number of frames are not used. A recorded type that the preset does not know is simulated
as the material that `--as` names.

Printed are, per trajectory and averaged, the mean squared distances ×10⁻³ over the first frames (over particles and
dimensions), beside those of `still` (nothing moves), of `fall` (free fall, stopped by the box) and of `nudged` (ours
beside itself after a nudge of 10⁻⁶ to the initial positions: what chaos alone does). Then for the last frame, as
recorded and as simulated: the height of the centre of mass, kinetic energy per mass, the width that holds the middle
96% and the height that holds the lower 98%, and the exact earth mover's distance between the two (Euclidean, per
particle).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from nmpm.data.format import Split, Trajectory
from nmpm.sim import InitialState, Preset, load_preset
from nmpm.sim.preset import BOUNDARY

Positions = NDArray[np.float64]

HORIZONS = (8, 32, 100, 200, 400)


def main() -> None:
    """Simulate, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("preset")
    parser.add_argument("--splits", nargs="+", default=["test"])
    parser.add_argument("--as", nargs="+", default=[], dest="aliases", metavar="TYPE=MATERIAL")
    given = parser.parse_args()
    preset = load_preset(given.preset)
    if preset.scene.gravity is None:
        raise SystemExit(f"{given.preset} has no gravity of its own to start recordings with.")
    aliases = {int(number): name for number, name in (alias.split("=") for alias in given.aliases)}
    errors: list[Mapping[str, Positions]] = []
    bulks: list[Positions] = []
    write_line(" " * 22 + "".join(f"{horizon:>11}" for horizon in (*HORIZONS, "full")))
    for split in given.splits:
        recordings = Split(given.folder / f"{split}.h5")
        for index in range(len(recordings)):
            found, bulk = compared(preset, recordings.read(index), aliases)
            errors.append(found)
            bulks.append(bulk)
            table(f"{split} {recordings.names[index]}", found)
    table("mean", {key: np.mean([found[key] for found in errors], axis=0) for key in errors[0]})
    recorded, ours, apart = np.mean(bulks, axis=0)
    write_line("\nlast frame" + "".join(f"{name:>12}" for name in ("height", "energy", "width", "top", "distance")))
    write_line("recorded  " + "".join(f"{value:12.5f}" for value in recorded[:4]))
    write_line("simulated " + "".join(f"{value:12.5f}" for value in ours[:4]) + f"{apart[0]:12.5f}")


def compared(
    preset: Preset, trajectory: Trajectory, aliases: Mapping[int, str]
) -> tuple[Mapping[str, Positions], Positions]:
    """Mean squared distances of each of ours, still, fall and nudged at the horizons; and bulk figures (3, 4)."""
    order, counts = sorted_by_material(preset, trajectory.particle_type, aliases)
    recorded = trajectory.position[:, order].astype(np.float64)
    dt, fall = preset.frame_dt, np.array(preset.scene.gravity)
    # The mean velocity between the frames, and what gravity's kicks, one per substep, add until the second.
    velocity = (recorded[1] - recorded[0]) / dt + fall * dt / 2 * (1 - 1 / preset.substeps)
    frames = len(recorded) - 2
    ours = simulated(preset, recorded[1], velocity, frames, counts)
    nudge = np.random.default_rng(0).normal(scale=1e-6, size=recorded[1].shape)
    low, high = np.array(preset.scene.bounds).T
    nudged = simulated(preset, np.clip(recorded[1] + nudge, low, high), velocity, frames, counts)
    times = dt * np.arange(1, frames + 1)[:, None, None]
    falling = np.clip(recorded[1] + times * velocity + times**2 / 2 * fall, low, high)
    truth = recorded[2:]
    errors = {
        "ours": means(ours - truth),
        "still": means(recorded[1] - truth),
        "fall": means(falling - truth),
        "nudged": means(nudged - ours),
    }
    cost = cdist(ours[-1], truth[-1])
    apart = cost[linear_sum_assignment(cost)].mean()
    return errors, np.stack([bulk(truth, dt), bulk(ours, dt), np.full(4, apart)])


def sorted_by_material(
    preset: Preset, particle_type: NDArray[np.int64], aliases: Mapping[int, str]
) -> tuple[NDArray[np.int64], tuple[int, ...]]:
    """The order that sorts particles as the preset's materials, and how many there are of each."""
    kinds = {number: name for number, name in preset.type_names.items() if number != BOUNDARY}
    places = {number: k for k, number in enumerate(kinds)}
    names = {name: k for k, name in enumerate(kinds.values())}
    places |= {number: names[name] for number, name in aliases.items()}
    unknown = sorted(set(particle_type.tolist()) - set(places))
    if unknown:
        raise SystemExit(f"Preset {preset.name} has no material for the types {unknown}; name one by --as.")
    place = np.array([places[number] for number in particle_type.tolist()])
    counts = tuple(int(np.sum(place == k)) for k in range(len(kinds)))
    return np.argsort(place, kind="stable"), counts


def simulated(
    preset: Preset, position: Positions, velocity: Positions, frames: int, counts: tuple[int, ...]
) -> Positions:
    """Our positions after the given state, (frames, N, 2)."""
    made = preset.simulate_from(InitialState(position, velocity, counts=counts), frames)
    return made.position[1:].astype(np.float64)


def means(difference: Positions) -> Positions:
    """Mean squared distances over the frames up to each horizon."""
    each = np.mean(difference**2, axis=(1, 2))
    return np.array([each[:horizon].mean() for horizon in (*HORIZONS, len(each))])


def bulk(positions: Positions, dt: float) -> Positions:
    """Height of the centre of mass, kinetic energy per mass, width and top of the last frame."""
    last = positions[-1]
    energy = np.sum(((last - positions[-2]) / dt) ** 2, axis=-1).mean() / 2
    left, right = np.percentile(last[:, 0], [2, 98])
    return np.array([last[:, 1].mean(), energy, right - left, np.percentile(last[:, 1], 98)])


def table(name: str, errors: Mapping[str, Positions]) -> None:
    """One line per predictor."""
    for key, values in errors.items():
        write_line(f"{name:<14}{key:<8}" + "".join(f"{1e3 * value:11.5f}" for value in values))


def write_line(line: Any) -> None:
    """One line of the result."""
    sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    main()
