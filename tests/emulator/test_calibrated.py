"""What a model's calibration says of gravity, in the units of the data."""

import pytest
import torch

from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.calibration import calibrated_range, gravity_range, usual_gravity, with_usual_gravity
from nmpm.processors import Pointwise
from tests.scenes import box, cloud, set_gravity_statistics


def turned(dim=2, **limits):
    """An emulator of scenes in which gravity of 10 length/s² points to either side of down, calibrated up to 12."""
    emulator = EmulatorRecipe(box(dim, gravity=None, gravity_varies=True), 14, 2, processor=Pointwise()).build().eval()
    rest = [0.0] * (dim - 2)
    usual = {"input_mean": [0, -8, *rest], "input_std": [6, 0, *rest]}
    calibrated = {"input_low": [-12] * dim, "input_high": [12] * dim}
    set_gravity_statistics(emulator, **usual | calibrated | limits)
    return emulator


@pytest.mark.parametrize("dim", [2, 3])
def test_the_usual_gravity_is_the_root_mean_square_downwards(dim):
    expected = torch.tensor([0.0, -10.0] + [0.0] * (dim - 2), dtype=torch.float64)
    torch.testing.assert_close(usual_gravity(turned(dim)), expected, rtol=1e-5, atol=1e-6)


def test_ranges_are_in_the_units_of_the_data():
    low, high = gravity_range(turned())
    torch.testing.assert_close(low, torch.tensor([-12.0, -12.0]).double())
    torch.testing.assert_close(high, -low)
    low, high = calibrated_range(turned(), "goop.velocity_")
    assert low.isneginf().all()
    assert high.isposinf().all()


def test_states_get_the_usual_gravity_where_scenes_differ_in_it():
    emulator, dt = turned(), 0.0025
    state = with_usual_gravity(emulator, cloud(emulator.scene, batch=3))
    torch.testing.assert_close(state.gravity / dt**2, torch.tensor([[0.0, -10.0]]).expand(3, 2))
    known = EmulatorRecipe(box(), 14, 2, processor=Pointwise()).build()
    same = cloud(known.scene)
    assert with_usual_gravity(known, same) is same
