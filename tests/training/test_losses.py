import dataclasses

import pytest
import torch

from nmpm.emulator import Rollout
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Window
from nmpm.testing import LossContract
from nmpm.training.losses import PositionLoss, density_error, position_error, position_errors
from tests.scenes import box, cloud, emulator_of, padded, window_of


@pytest.mark.parametrize("loss", [PositionLoss(), PositionLoss(1.0, 0.0), PositionLoss(0.1, 1.0, 0.0)], ids=str)
class TestPositionLoss(LossContract):
    @pytest.fixture(autouse=True)
    def choose(self, loss):
        self.loss = loss


def loss_of(predicted, window, frames, power=0.5, density_weight=0.0):
    """The loss of positions in a box of 42 cells, in bundles of so many frames."""
    loss = PositionLoss(power, density_weight)
    return loss(Rollout(predicted, {}), window, emulator_of(box(), 42, frames))


def at(*places: tuple[float, float], materials=("goop",), material=0):
    """Particles at places in cells from the domain's lower corner: scene, grid, positions (1, 1, N, 2), window."""
    scene = box(materials=materials)
    grid = Grid.of(scene, 42)
    position, state = grid.to_length(torch.tensor([places])), cloud(scene, count=len(places))
    material = torch.as_tensor(material).expand(1, len(places))
    state = dataclasses.replace(state, position=position, material=material)
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
    scene, grid, there, window = at(*places, materials=("water", "sand"), material=[0, 1, 1])
    assert density_error(swapped, there, window, scene, grid).item() > 1e-3


def test_its_gradient_drives_crowded_particles_apart():
    scene, grid, apart, window = at((9.8, 10.5), (12.2, 10.5))
    *_, crowded, _ = at((10.3, 10.5), (11.7, 10.5))
    density_error(crowded.requires_grad_(), apart, window, scene, grid).backward()
    left, right = crowded.grad[0, 0, :, 0]
    assert left > 0 > right  # descent moves the left one to the left, the right one to the right


def test_the_density_error_of_a_batch_is_the_mean_over_its_particles():
    scene, grid = box(), Grid.of(box(), 42)
    window = Window.of(cloud(scene, count=5, batch=2))
    there = window.frames[:, 1:]
    moved = there + torch.tensor([0.2, 0.5]).view(2, 1, 1, 1) * grid.spacing[0]
    alone = [density_error(moved[i], there[i], window.scenes(i), scene, grid) for i in (slice(0, 1), slice(1, 2))]
    together = density_error(moved, there, window, scene, grid)
    torch.testing.assert_close(together, torch.stack(alone).mean())


def calm_and_violent(frames: int = 4):
    """Two windows of one particle that is still: scene, grid, window, and predictions 0.1 and 10 cells away."""
    scene, grid = box(), Grid.of(box(), 42)
    state = cloud(scene, batch=2, count=1)
    window = window_of(state, state.position.unsqueeze(1).expand(-1, frames + 2, -1, -1))
    away = grid.spacing[0] * torch.tensor([[0.1, 0.0], [10.0, 0.0]])
    return scene, grid, window, window.target + away[:, None, None]


def test_errors_of_windows_and_bundles_average_to_those_of_all():
    _, grid, window, predicted = calm_and_violent()
    errors = position_errors(predicted, window.target, window.mask, grid, 2)
    torch.testing.assert_close(errors, torch.tensor([[0.005] * 2, [50.0] * 2]), rtol=1e-3, atol=0)
    torch.testing.assert_close(errors.mean(), position_error(predicted, window.target, window.mask, grid))


@pytest.mark.parametrize("power", [1.0, 0.5])
def test_at_power_one_half_a_calm_window_weighs_as_much_as_a_violent_one(power):
    _, _, window, predicted = calm_and_violent()
    scale = torch.ones(2, requires_grad=True)
    moved = window.target + scale[:, None, None, None] * (predicted - window.target)
    (share,) = torch.autograd.grad(loss_of(moved, window, 2, power), scale)
    # d/ds of (s² e)^p is 2 p e^p at s = 1.
    torch.testing.assert_close(share, power * torch.tensor([0.005, 50.0]) ** power, rtol=2e-2, atol=0)


def test_the_density_error_is_added_as_it_is():
    scene, grid, window, predicted = calm_and_violent()
    last = slice(1, None, 2)
    density = density_error(predicted[:, last], window.target[:, last], window, scene, grid)
    alone, both = (loss_of(predicted, window, 2, 0.5, weight) for weight in (0.0, 3.0))
    torch.testing.assert_close(both, alone + 3 * density)


def test_padding_changes_no_error_of_positions_and_densities():
    scene, grid = box(), Grid.of(box(), 42)
    state, errors = cloud(scene, count=2), []
    for each, shift in ((state, [0.3, 0.3]), (padded(state, torch.tensor([[0.6, 0.6]])), [0.3, 0.3, 5.0])):
        window = window_of(each, each.position.unsqueeze(1).expand(-1, 3, -1, -1))
        predicted = window.target + torch.tensor(shift)[:, None] * grid.spacing[0]
        errors.append(loss_of(predicted, window, 1, density_weight=1.0))
    torch.testing.assert_close(*errors)


def test_frames_that_do_not_match_are_refused_and_longer_windows_cut():
    _, _, window, predicted = calm_and_violent(frames=4)
    for wrong, cut, frames, complaint in (
        (torch.cat([predicted, predicted], 1), window, 4, r"Predicted \(2, 8, 1, 2\) and target \(2, 4, 1, 2\)"),
        (predicted, window, 3, "4 predicted frames are no whole number of bundles of 3"),
        (predicted, window.first(3), 2, "do not match"),  # whose single frame would broadcast
    ):
        with pytest.raises(ValueError, match=complaint):
            loss_of(wrong, cut, frames)
    short = predicted[:, :2]
    assert torch.equal(loss_of(short, window, 2), loss_of(short, window.first(4), 2))


@pytest.mark.parametrize(("power", "members", "complaint"), [
    (1.5, 1, r"loss\.power = .* above 0 and at most 1"), (1.0, 2, r"loss\.power = 1"), (0.5, 0, "members = 0"),
])  # fmt: skip
def test_what_no_loss_can_score_is_refused(power, members, complaint):
    with pytest.raises(ConfigError, match=complaint):
        PositionLoss(power).check_members(members)


def test_the_error_of_fields_is_the_mean_square_in_units_of_the_spread():
    state = cloud(box(), count=3, batch=2)
    state.mask[1, 1:] = False
    window = window_of(state, state.position.unsqueeze(1).expand(-1, 6, -1, -1))
    window.fields = {"heat": torch.zeros(2, 6, 3)}
    heat = torch.full((2, 4, 3), 0.2)
    heat[1, :, 1:] = 1e6
    emulator = emulator_of(box(evolving=("heat",)), 42, 2)
    emulator.field_scales.std.fill_(0.1)
    error = PositionLoss(0.5, 0.0)(Rollout(window.target, {"heat": heat, "other": heat}), window, emulator)
    assert float(error) == pytest.approx((4 + 1e-4) ** 0.5 + 1e-2)  # that of perfect positions is the floor's root
