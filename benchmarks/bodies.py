"""Ramps on the grid: soft bodies and filling particles against the exact mean, their fields and their derivatives.

    python benchmarks/bodies.py --model waterramps --ramps 20

The exact field has the model's p2g of 12 x 12 points per cell, each wholly inside or outside but for a band as wide as
a point. Deviations are root mean squares over the cells that either field reaches, in shares of a cell; those of
derivatives with respect to the angle are relative to the exact derivative. "whole" ramps have sides of whole numbers of
particle spacings; others are filled by a rounded number of rows, which is another area.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from nmpm.emulator import Emulator
from nmpm.emulator.bodies import BAND, SAMPLES, lattice, solid_share
from nmpm.obstacles import Ramp
from nmpm.zoo import Zoo

Field = Callable[[Ramp], Tensor]
"""From a ramp to the share of each cell that it takes, (1, 1, *S)."""

FINE = 12
CHOICES = ((2, 0.5), (SAMPLES, BAND / 2), (SAMPLES, BAND), (SAMPLES, 2 * BAND), (4, 0.5))


def main() -> None:
    """Print a row for each way to rasterise."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--model", default="waterramps", help="name in the zoo, of scenes with obstacles")
    parser.add_argument("--ramps", type=int, default=20)
    chosen = parser.parse_args()
    emulator = Zoo.load(chosen.model).emulator
    ways: dict[str, Field] = {"particles": partial(filled, emulator)} | {
        f"{samples} x {samples} points, band {band:g}": partial(sampled, emulator, samples, band)
        for samples, band in CHOICES
    }
    sys.stdout.write(f"{chosen.model}, {chosen.ramps} ramps\n{'':<26}{'field':>8}{'slope':>8}{'whole: field':>14}\n")
    ramps, whole = (draw_ramps(emulator, chosen.ramps, sides) for sides in (False, True))
    exact, exact_whole = (with_slopes(partial(sampled, emulator, FINE, 1 / FINE), drawn) for drawn in (ramps, whole))
    for name, way in ways.items():
        field, slope = deviations(with_slopes(way, ramps), exact)
        alone, _ = deviations(with_slopes(way, whole), exact_whole)
        sys.stdout.write(f"{name:<26}{field:>8.4f}{slope:>8.2f}{alone:>14.4f}\n")


def draw_ramps(emulator: Emulator, count: int, whole: bool) -> list[tuple[Tensor, float, float, float]]:
    """Centres, lengths, thicknesses and angles after those of the presets, in the middle of the domain."""
    random = torch.Generator().manual_seed(0)
    low, high = torch.tensor(emulator.scene.bounds, dtype=torch.float64).T
    spacing, found = emulator.scene.particle_spacing, []
    for _ in range(count):
        x, y, size, slope = torch.rand(4, generator=random, dtype=torch.float64)
        centre = low + (high - low) * (0.25 + 0.5 * torch.stack([x, y]))
        sides = [0.1 + 0.2 * float(size), 0.03]
        if whole:
            sides = [round(side / spacing) * spacing for side in sides]
        found.append((centre, *sides, math.radians(-50 + 100 * float(slope))))
    return found


def filled(emulator: Emulator, ramp: Ramp) -> Tensor:
    """The field of the particles that fill a ramp."""
    grid, scene = emulator.grid, emulator.scene
    cells = grid.to_cells(ramp.particles(scene.particle_spacing), torch.float64).unsqueeze(0)
    volumes = cells.new_full((*cells.shape[:2], 1), scene.particle_volume / grid.cell_volume)
    return emulator.transfer.p2g(volumes, cells, grid)


def sampled(emulator: Emulator, samples: int, band: float, ramp: Ramp) -> Tensor:
    """The field of a ramp that is sampled softly, see `nmpm.emulator.bodies`."""
    grid = emulator.grid
    points = lattice(grid, samples).unsqueeze(0)
    share = solid_share(ramp.distance(points), band * min(grid.spacing))
    return emulator.transfer.p2g(share.unsqueeze(-1) / samples**grid.dim, grid.to_cells(points, torch.float64), grid)


def deviations(one: Tensor, exact: Tensor) -> tuple[float, float]:
    """Of fields (R, 2, …) from `with_slopes`, and of their derivatives, relative to the exact ones."""
    reached = (one[:, 0] != 0) | (exact[:, 0] != 0)
    apart, size = (float((values[:, 1][reached]).square().mean().sqrt()) for values in (one - exact, exact))
    return float((one - exact)[:, 0][reached].square().mean().sqrt()), apart / size


def with_slopes(field: Field, ramps: list[tuple[Tensor, float, float, float]]) -> Tensor:
    """(R, 2, 1, 1, *S) fields of R ramps, and their derivatives by the angle."""
    return torch.stack([torch.stack(with_slope(field, *ramp)) for ramp in ramps])


def with_slope(field: Field, centre: Tensor, length: float, thickness: float, angle: float) -> tuple[Tensor, Tensor]:
    """A ramp's field and its derivative by the angle."""
    found: tuple[Tensor, Tensor] = torch.autograd.functional.jvp(
        lambda turned: field(Ramp(centre, length, thickness, turned)),
        torch.tensor(angle, dtype=torch.float64),
        torch.ones((), dtype=torch.float64),
    )
    return found


if __name__ == "__main__":
    main()
