import dataclasses

import pytest
import torch
from scenes import box, cloud

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Window
from nmpm.training.losses import TrainingError, density_error, position_error, position_errors


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
    names = [f.name for f in dataclasses.fields(first) if isinstance(getattr(first, f.name), torch.Tensor)]
    fields = {name: torch.cat([getattr(w, name) for *_, w in scenes]) for name in names}
    together = density_error(torch.cat(moved), torch.cat([t for _, _, t, _ in scenes]), Window(**fields), scene, grid)
    torch.testing.assert_close(together, torch.stack(alone).mean())


# ---- errors of windows, and their powers


def calm_and_violent(frames: int = 4):
    """Two windows of one particle that is still: scene, grid, window, and predictions 0.1 and 10 cells away."""
    scene = box()
    grid = Grid.of(scene, 42)
    state = cloud(scene, batch=2, count=1)
    still = Window.of(state)
    window = dataclasses.replace(still, frames=state.position.unsqueeze(1).expand(-1, frames + 2, -1, -1))
    away = grid.spacing[0] * torch.tensor([[0.1, 0.0], [10.0, 0.0]])
    return scene, grid, window, window.target + away[:, None, None]


def test_errors_of_windows_and_bundles_average_to_those_of_all():
    _, grid, window, predicted = calm_and_violent()
    errors = position_errors(predicted, window.target, window.mask, grid, 2)
    torch.testing.assert_close(errors, torch.tensor([[0.005] * 2, [50.0] * 2]), rtol=1e-3, atol=0)
    torch.testing.assert_close(errors.mean(), position_error(predicted, window.target, window.mask, grid))


def test_at_power_one_half_a_calm_window_weighs_as_much_as_a_violent_one():
    scene, grid, window, predicted = calm_and_violent()
    shares = {}
    for power in (1.0, 0.5):
        scale = torch.ones(2, requires_grad=True)
        moved = window.target + scale[:, None, None, None] * (predicted - window.target)
        error = TrainingError(power=power)(moved, window, scene, grid, 2)
        # d/ds of (s² e)^p is 2 p e^p at s = 1.
        shares[power] = torch.autograd.grad(error, scale)[0]
    torch.testing.assert_close(shares[1.0], torch.tensor([0.005, 50.0]), rtol=1e-3, atol=0)
    torch.testing.assert_close(shares[0.5], torch.tensor([0.005, 50.0]).sqrt() / 2, rtol=2e-2, atol=0)


def test_the_density_error_is_added_as_it_is():
    scene, grid, window, predicted = calm_and_violent()
    last = slice(1, None, 2)
    density = density_error(predicted[:, last], window.target[:, last], window, scene, grid)
    alone, both = (TrainingError(weight, 0.5)(predicted, window, scene, grid, 2) for weight in (0.0, 3.0))
    torch.testing.assert_close(both, alone + 3 * density)


def test_perfect_predictions_have_finite_gradients_at_any_power():
    scene, grid, window, _ = calm_and_violent()
    moved = window.target.clone().requires_grad_()
    TrainingError(density_weight=1.0, power=0.1)(moved, window, scene, grid, 4).backward()
    assert moved.grad is not None
    assert moved.grad.isfinite().all()


def test_padding_changes_no_tempered_error():
    places = ((10.3, 12.1), (15.2, 11.4))
    scene, grid, there, window = at(*places)
    error = TrainingError(1.0, 0.5)
    window = dataclasses.replace(window, frames=there.expand(-1, 3, -1, -1))
    expected = error(there + 0.3 * grid.spacing[0], window, scene, grid, 1)
    scene, grid, more, padded = at(*places, (30.0, 30.0), mask=(True, True, False))
    padded = dataclasses.replace(padded, frames=more.expand(-1, 3, -1, -1))
    shift = torch.tensor([0.3, 0.3, 5.0])[:, None] * grid.spacing[0]
    torch.testing.assert_close(error(more + shift, padded, scene, grid, 1), expected)


@pytest.mark.parametrize("weight", [0.0, 1.0])
@pytest.mark.parametrize("power", [0.5, 1.0])
def test_more_predicted_frames_than_the_window_has_are_refused(power, weight):
    scene, grid, window, predicted = calm_and_violent(frames=4)
    error = TrainingError(weight, power)
    with pytest.raises(ValueError, match=r"Predicted \(2, 8, 1, 2\) and target \(2, 4, 1, 2\) positions do not match"):
        error(torch.cat([predicted, predicted], 1), window, scene, grid, 4)
    with pytest.raises(ValueError, match="4 predicted frames are no whole number of bundles of 3"):
        error(predicted, window, scene, grid, 3)
    one = dataclasses.replace(window, frames=window.frames[:, :3])  # whose single frame would broadcast
    with pytest.raises(ValueError, match="do not match"):
        error(predicted, one, scene, grid, 2)


def test_a_longer_window_is_compared_up_to_the_prediction():
    scene, grid, window, predicted = calm_and_violent(frames=4)
    error = TrainingError(1.0, 0.5)
    short = dataclasses.replace(window, frames=window.frames[:, :4])
    assert torch.equal(error(predicted[:, :2], window, scene, grid, 2), error(predicted[:, :2], short, scene, grid, 2))


@pytest.mark.parametrize("power", [0.0, -1.0, 1.5])
def test_powers_out_of_range_are_named(power):
    with pytest.raises(ConfigError, match=r"error_power = .* above 0 and at most 1"):
        TrainingError(power=power)
