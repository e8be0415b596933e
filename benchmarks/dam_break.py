"""The dam break beside JAX-SPH's, from the same first frame: how near the two simulators stay over time.

python benchmarks/dam_break.py --data $NMPM_TEST_DATA/jaxsph-dambreak-2d

The recording is one run of LagrangeBench's dam break. Its first frame, a relaxed column of 5000 particles, starts ours,
and the same quantities are taken from both at the same times:

- front: largest x of the water, from the left wall;
- left, right: depth of the water next to the wall, its area within 0.2 of it over 0.2;
- crest: the height below which 99% of the water within 0.2 of the right wall is, while there are a few particles;
- energy: kinetic, of all the water, from differences over two frames;
- x, y: centre of mass;
- apart: median distance to the nearest particle, in spacings.

Once the wave breaks the flow is chaotic, and only averages can agree. How nearly is shown by ours beside itself after
a nudge of 10⁻⁶ to the initial positions. The last line gives the root mean square distance between the same particles
of the two simulators.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nmpm.sim import InitialState, load_preset
from nmpm.sim.sph.preset import SphPreset

Water = NDArray[np.float64]
Series = dict[str, NDArray[np.float64]]

TIMES = (0.5, 1.0, 1.5, 2.0, 2.4, 3.0, 5.0, 8.0, 12.0)
IMPACT = 2.4
STRIP = 0.2
FLUID = 0  # the recording's type of fluid particles


def main() -> None:
    """Simulate, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    folder = Path(os.environ.get("NMPM_TEST_DATA", "")) / "jaxsph-dambreak-2d"
    parser.add_argument(
        "--data",
        type=Path,
        default=folder,
        help="folder of the recording, with test.h5 (default: jaxsph-dambreak-2d in the folder NMPM_TEST_DATA)",
    )
    chosen = parser.parse_args()
    path = chosen.data / "test.h5"
    if not path.is_file():
        parser.error(f"--data {chosen.data}: there is no {path}.")
    compare(recording(path))


def compare(recorded: Water) -> None:
    """Simulate from the first recorded frame, and print both beside one another."""
    preset = load_preset("dambreak2d")
    if not isinstance(preset, SphPreset):
        raise TypeError("dambreak2d is not simulated by WCSPH.")
    ours = simulated(preset, recorded[0])
    nudged = simulated(preset, recorded[0] + np.random.default_rng(0).normal(scale=1e-6, size=recorded[0].shape))
    series, floor = measured(ours, preset), measured(nudged, preset)
    table(measured(recorded, preset), series, preset.frame_dt)
    deviations("nmpm from JAX-SPH", series, measured(recorded, preset), preset.frame_dt)
    deviations("nmpm from itself, nudged", floor, series, preset.frame_dt)
    apart = [np.sqrt(((ours[n] - recorded[n]) ** 2).sum(-1).mean()) for n in frames(preset.frame_dt)]
    write_line("\nRMS distance of the same particles: " + ", ".join(f"{d:.4f}" for d in apart))


def simulated(preset: SphPreset, start: Water) -> Water:
    """Our water from the same start, (401, 5000, 2); prints how long it took."""
    begin = time.perf_counter()
    made = preset.simulate_from(InitialState(start, np.zeros_like(start)), preset.frames, show_frame)
    seconds = time.perf_counter() - begin
    steps = preset.frames * preset.substeps * len(start)
    write_line(f"\n{seconds:.0f} s, {steps / seconds / 1e6:.2f} million particle-steps per second, {made.attributes}\n")
    return made.position[:, : len(start)].astype(np.float64)


def recording(path: Path) -> Water:
    """The recorded water, (401, 5000, 2)."""
    with h5py.File(path) as file:
        group = file["00000"]
        return np.asarray(group["position"][:, group["particle_type"][:] == FLUID], np.float64)


def measured(water: Water, preset: SphPreset) -> Series:
    """Every quantity over time, (T,) each."""
    (left, right), (bottom, _) = preset.box
    x, y = water[..., 0], water[..., 1]
    near_left, near_right = x < left + STRIP, x > right - STRIP
    speed = np.gradient(water, preset.frame_dt, axis=0)
    area = preset.particle_volume
    return {
        "front": x.max(axis=1) - left,
        "left": near_left.sum(axis=1) * area / STRIP,
        "right": near_right.sum(axis=1) * area / STRIP,
        "crest": np.array([crest(h[near]) for h, near in zip(y - bottom, near_right, strict=True)]),
        "energy": 0.5 * area * (speed**2).sum(axis=(1, 2)),
        "x": x.mean(axis=1) - left,
        "y": y.mean(axis=1) - bottom,
        "apart": np.array([np.median(cKDTree(w).query(w, k=2)[0][:, 1]) for w in water]) / preset.spacing,
    }


def crest(heights: NDArray[Any]) -> float:
    """Height below which 99% of some particles are; 0 where there are ten or fewer."""
    return float(np.quantile(heights, 0.99)) if len(heights) > 10 else 0.0


def frames(dt: float) -> list[int]:
    """Frames nearest to the times."""
    return [round(t / dt) for t in TIMES]


def table(theirs: Series, ours: Series, dt: float) -> None:
    """Both at the times."""
    write_line("JAX-SPH / nmpm\n")
    write_line("| t | " + " | ".join(ours) + " |")
    write_line("| --- |" + " --- |" * len(ours))
    for n in frames(dt):
        write_line(f"| {n * dt:.2f} | " + " | ".join(f"{theirs[k][n]:.3f} / {ours[k][n]:.3f}" for k in ours) + " |")


def deviations(name: str, series: Series, reference: Series, dt: float) -> None:
    """Largest deviations before and after the wave hits the wall, as parts of the reference's largest value."""
    impact = round(IMPACT / dt)
    for when, part in ((f"until {IMPACT}", slice(1, impact + 1)), (f"after {IMPACT}", slice(impact + 1, None))):
        largest = [(np.abs(series[k] - reference[k])[part].max(), np.abs(reference[k][part]).max()) for k in series]
        cells = (f"{error / scale:.2%}" if scale else "–" for error, scale in largest)
        write_line(f"| {name}, {when} | " + " | ".join(cells) + " |")


def write_line(line: str) -> None:
    """One line of the result."""
    sys.stdout.write(line + "\n")


def show_frame(frame: int) -> None:
    """One line of progress."""
    sys.stderr.write(f"\rframe {frame}")


if __name__ == "__main__":
    main()
