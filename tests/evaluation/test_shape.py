import dataclasses

import pytest
import torch
from scenes import box, cloud

from nmpm.grid import Grid
from nmpm.metrics.quantities import measure_shape


def lattice_state(count: int, spacing: float, corner: tuple[float, float] = (0.1, 0.1)):
    """A square block of count × count particles whose lower left corner is given."""
    scene = box()
    axis = (torch.arange(count) + 0.5) * spacing
    position = torch.stack(torch.meshgrid(corner[0] + axis, corner[1] + axis, indexing="ij"), dim=-1).reshape(1, -1, 2)
    state = cloud(scene)
    number = position.shape[1]
    state = dataclasses.replace(
        state,
        position=position,
        velocity=torch.zeros_like(position),
        material=torch.zeros(1, number, dtype=torch.int64),
        mask=torch.ones(1, number, dtype=torch.bool),
    )
    return scene, state


def test_twice_the_particles_in_the_same_cells_are_twice_as_crowded():
    scene, state = lattice_state(20, 0.01)
    grid = Grid.of(scene, 42)  # cells of 0.02: four particles in each
    loose = measure_shape(scene, grid, state, state.position)
    assert loose["occupied"].item() == 100
    assert loose["crowding"].item() == loose["peak_crowding"].item() == 4
    squeezed = state.position.clone()
    squeezed[..., 1] = 0.1 + (squeezed[..., 1] - 0.1) / 2
    ratios = {name: (value / loose[name]).item() for name, value in measure_shape(scene, grid, state, squeezed).items()}
    assert ratios == pytest.approx({"height": 0.5, "occupied": 0.5, "crowding": 2.0, "peak_crowding": 2.0}, rel=1e-4)


def test_height_is_measured_against_gravity_whatever_its_direction():
    scene, state = lattice_state(20, 0.01)
    sideways = dataclasses.replace(state, gravity=torch.tensor([[-1e-5, 0.0]]))
    upside_down = dataclasses.replace(state, gravity=torch.tensor([[0.0, 1e-5]]))
    grid = Grid.of(scene, 42)
    assert measure_shape(scene, grid, sideways, state.position)["height"].item() == pytest.approx(0.1, rel=1e-4)
    assert measure_shape(scene, grid, upside_down, state.position)["height"].item() == pytest.approx(0.7, rel=1e-4)


def test_padding_changes_nothing():
    scene, state = lattice_state(10, 0.01)
    grid = Grid.of(scene, 42)
    padded = dataclasses.replace(
        state,
        position=torch.cat([state.position, torch.full((1, 7, 2), 0.5)], dim=1),
        velocity=torch.zeros(1, 107, 2),
        material=torch.zeros(1, 107, dtype=torch.int64),
        mask=torch.arange(107).unsqueeze(0) < 100,
    )
    assert measure_shape(scene, grid, padded, padded.position) == measure_shape(scene, grid, state, state.position)
