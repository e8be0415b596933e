import dataclasses

import pytest
import torch
from scenes import box, cloud

from nmpm.grid import Grid
from nmpm.particles import Window
from nmpm.training.losses import density_error


def at(*places: tuple[float, float], cells: int = 42, materials=("goop",), material=None, mask=None):
    """Particles at places in cells from the domain's lower corner: scene, grid, positions (1, 1, N, 2), window."""
    scene = box(materials=materials)
    grid = Grid.of(scene, cells)
    position = grid.to_length(torch.tensor([places], dtype=torch.float32))
    count = position.shape[1]
    state = dataclasses.replace(
        cloud(scene, count=count),
        position=position,
        material=torch.zeros(1, count, dtype=torch.int64) if material is None else torch.tensor([material]),
        mask=torch.ones(1, count, dtype=torch.bool) if mask is None else torch.tensor([mask]),
    )
    return scene, grid, position.unsqueeze(1), Window.of(state)


def test_two_particles_that_merge_have_the_error_of_the_closed_form():
    # Both on nodes: apart, φ is f at two nodes; merged, 2 f at one. Σ (φ' - φ)² = 2 f², Σ φ = 2 f.
    scene, grid, apart, window = at((10.5, 10.5), (20.5, 10.5))
    *_, merged, _ = at((10.5, 10.5), (10.5, 10.5))
    fraction = scene.particle_volume / grid.cell_volume
    assert density_error(merged, apart, window, scene, grid).item() == pytest.approx(fraction / 2, rel=1e-4)


def test_particles_that_swap_places_have_no_error_and_materials_are_told_apart():
    places = ((10.3, 12.1), (15.2, 11.4), (20.9, 13.3))
    scene, grid, there, window = at(*places)
    swapped = there[:, :, [2, 0, 1]]
    assert density_error(swapped, there, window, scene, grid).item() == pytest.approx(0, abs=1e-12)
    scene, grid, there, window = at(*places, materials=("water", "sand"), material=(0, 1, 1))
    assert density_error(swapped, there, window, scene, grid).item() > 1e-3


def test_padding_changes_nothing():
    scene, grid, there, window = at((10.3, 12.1), (15.2, 11.4))
    moved = there + 0.3 * grid.spacing[0]
    error = density_error(moved, there, window, scene, grid)
    scene, grid, there, window = at((10.3, 12.1), (15.2, 11.4), (30.0, 30.0), mask=(True, True, False))
    moved = there.clone()
    moved[:, :, :2] += 0.3 * grid.spacing[0]
    moved[:, :, 2] += 5 * grid.spacing[0]
    torch.testing.assert_close(density_error(moved, there, window, scene, grid), error)


def test_its_gradient_drives_crowded_particles_apart():
    scene, grid, apart, window = at((9.8, 10.5), (12.2, 10.5))
    *_, crowded, _ = at((10.3, 10.5), (11.7, 10.5))
    crowded.requires_grad_()
    density_error(crowded, apart, window, scene, grid).backward()
    assert crowded.grad is not None
    left, right = crowded.grad[0, 0, :, 0]
    assert left > 0 > right  # descent moves the left one to the left, the right one to the right


def test_the_error_of_a_batch_is_the_mean_over_its_particles():
    scenes = [at((10.3, 12.1), (15.2, 11.4), (16.0, 11.0)), at((9.0, 9.0), (9.5, 9.5), (14.0, 9.0))]
    moved = [there + 0.4 * grid.spacing[0] for _, grid, there, _ in scenes]
    alone = [
        density_error(m, there, window, scene, grid)
        for m, (scene, grid, there, window) in zip(moved, scenes, strict=True)
    ]
    scene, grid, _, first = scenes[0]
    fields = {f.name: torch.cat([getattr(w, f.name) for *_, w in scenes]) for f in dataclasses.fields(first)}
    together = density_error(torch.cat(moved), torch.cat([t for _, _, t, _ in scenes]), Window(**fields), scene, grid)
    torch.testing.assert_close(together, torch.stack(alone).mean())
