import pytest
import torch
from scenes import box, cloud
from scipy.optimize import linear_sum_assignment

from nmpm.evaluation.comparison import free_fall, still
from nmpm.grid import Grid
from nmpm.metrics import MSE, EarthMover, earth_mover, overall_error
from nmpm.particles import Window
from nmpm.training.losses import position_error


def recorded(target: torch.Tensor, mask: torch.Tensor | None = None, material: torch.Tensor | None = None) -> Window:
    """A window whose frames to predict (B, T, N, D) are given."""
    batch, _, count, dim = target.shape
    return Window(
        frames=torch.cat([target[:, :1].expand(-1, 2, -1, -1), target], dim=1),
        material=torch.zeros(batch, count, dtype=torch.int64) if material is None else material,
        mask=torch.ones(batch, count, dtype=torch.bool) if mask is None else mask,
        obstacle=torch.zeros(batch, 0, dim),
        obstacle_mask=torch.zeros(batch, 0, dtype=torch.bool),
        gravity=torch.zeros(batch, dim),
    )


def test_mse_at_h_is_the_mean_up_to_h_over_particles_and_dimensions():
    target = torch.zeros(2, 40, 5, 2)
    predicted = torch.arange(1, 41).view(1, -1, 1, 1).expand(2, 40, 5, 2).sqrt()  # squared error at frame i is i
    metric = MSE((1, 8, 32, 100))
    metric.update(recorded(target), predicted)
    found = {name: value.item() for name, value in metric.compute().items()}
    assert found == pytest.approx({"mse@1": 1.0, "mse@8": 4.5, "mse@32": 16.5, "mse": 20.5}, rel=1e-6)


def test_the_overall_error_is_the_geometric_mean_from_a_horizon_on():
    errors = {"mse@8": 1e-9, "mse@32": 1e-3, "mse@100": 1e-1, "mse": 10.0, "still/mse@100": 5.0, "mse_temperature": 7.0}
    tensors = {name: torch.tensor(value) for name, value in errors.items()}
    assert overall_error(tensors, 32).item() == pytest.approx(1e-1, rel=1e-5)  # (1e-3 1e-1 10) ** (1/3)
    assert overall_error(tensors, 8).item() == pytest.approx(1e-3, rel=1e-5)
    assert overall_error(tensors, 101).item() == pytest.approx(10.0, rel=1e-5)
    assert overall_error(tensors | {"mse": torch.tensor(torch.nan)}, 32).isnan()


def test_padding_does_not_count_and_trajectories_of_any_length_do():
    metric = MSE((2,))
    mask = torch.tensor([[True, True, False]])
    predicted = torch.zeros(1, 4, 3, 2)
    predicted[:, :, 2] = 1e6
    metric.update(recorded(torch.zeros_like(predicted), mask), predicted)
    metric.update(recorded(torch.zeros(1, 6, 1, 2)), torch.ones(1, 6, 1, 2))
    assert [len(curve) for curve in metric.curves()] == [4, 6]
    assert [row["mse"] for row in metric.per_trajectory()] == [0.0, 1.0]
    assert metric.compute()["mse"] == 0.5


@pytest.mark.parametrize(("particles", "dimensions"), [(1, 2), (7, 3), (200, 2)])
def test_earth_mover_is_the_cost_of_the_best_assignment(particles: int, dimensions: int):
    generator = torch.Generator().manual_seed(particles)
    ours, theirs = torch.rand(2, 3, particles, dimensions, generator=generator, dtype=torch.float64)
    costs = torch.cdist(ours, theirs).numpy()
    best = [cost[linear_sum_assignment(cost)].mean() for cost in costs]
    assert earth_mover(ours, theirs) == pytest.approx(sum(best) / 3, rel=1e-9)


def test_states_of_metrics_need_no_float64():
    """Not every device has it."""
    earth, errors = EarthMover(every=1), MSE()
    positions = torch.rand(2, 3, 4, 2)
    for metric in (earth, errors):
        metric.update(recorded(positions.flip(2)), positions)
    kept = [*earth.distances, *errors.squared, *errors.lengths]
    assert {values.dtype for values in kept} == {torch.float32, torch.int64}
    assert EarthMover().compute() == {}


def test_earth_mover_ignores_order_and_keeps_materials_apart():
    metric = EarthMover(every=1)
    ours = torch.tensor([[[[0.0, 0.0], [1.0, 0.0]]]])
    theirs = ours.flip(2)
    metric.update(recorded(theirs), ours)
    assert metric.compute()["emd"] == 0
    metric.reset()
    metric.update(recorded(theirs, material=torch.tensor([[0, 1]])), ours)
    assert metric.compute()["emd"] == 1


def test_earth_mover_of_a_rollout_that_is_not_finite_is_no_number_and_no_error():
    target = torch.rand(2, 20, 5, 2)
    broken = target.clone()
    broken[1, 9:, 3] = float("inf")
    metric = EarthMover(every=10)
    metric.update(recorded(target), broken)
    assert metric.distances[0].isnan().tolist() == [False, True]
    assert metric.compute()["emd"].isnan()


def test_loss_is_in_cells_whatever_the_unit_of_length():
    for factor in (1.0, 1e3):
        grid = Grid((10, 20), (0.0, 0.0), (0.1 * factor, 0.2 * factor), (False, False))
        target = torch.rand(2, 3, 4, 2) * factor
        moved = target + torch.tensor([0.1, 0.4]) * factor
        loss = position_error(moved, target, torch.ones(2, 4, dtype=torch.bool), grid)
        assert loss.item() == pytest.approx((1 + 4) / 2, rel=1e-3)


def test_loss_ignores_padding_and_is_no_number_for_an_empty_batch():
    grid = Grid((10, 10), (0.0, 0.0), (0.1, 0.1), (False, False))
    target, mask = torch.zeros(1, 2, 3, 2), torch.tensor([[True, True, False]])
    predicted = target.clone()
    predicted[..., 2, :] = 7
    assert position_error(predicted, target, mask, grid) == 0
    assert position_error(predicted, target, torch.zeros_like(mask), grid).isnan()


def test_free_fall_is_the_parabola_and_stops_at_the_first_wall():
    scene = box()
    particles = cloud(scene, speed=0.0)
    path = free_fall(scene, particles, 400)
    assert (still(particles, 7) == particles.position[:, None]).all()
    early = torch.arange(1, 11).view(1, -1, 1)
    fallen = particles.position[:, None, :, 1] + particles.gravity[0, 1] * early * (early + 1) / 2
    torch.testing.assert_close(path[:, :10, :, 1], fallen, atol=1e-6, rtol=0)
    torch.testing.assert_close(path[:, -1, :, 1], torch.full((1, 30), 0.1))
    thrown = particles.with_motion(particles.position, torch.tensor([0.0, 0.02]).expand_as(particles.position))
    assert (free_fall(scene, thrown, 400)[:, -1, :, 1] == torch.tensor(0.9)).all()
