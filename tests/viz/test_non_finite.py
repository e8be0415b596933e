import pytest
import torch

from nmpm.evaluation.pictures import labelled_trajectories
from nmpm.particles import Window
from nmpm.scene import Scene


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_non_finite_frame_ends_the_drawing_with_a_title(falling, bad):
    scene = Scene(falling.bounds, falling.domain, falling.dt, materials=("water", "sand"), particle_volume=1e-4)
    truth = torch.tensor(falling.positions["simulation"]).float()[None]
    window = Window(
        truth,
        material=torch.tensor([[0, 1]]),
        mask=torch.ones(1, 2, dtype=torch.bool),
        obstacle=torch.zeros(1, 0, 2),
        obstacle_mask=torch.zeros(1, 0, dtype=torch.bool),
        gravity=torch.zeros(1, 2),
    )
    predicted = truth[:, 2:].clone()
    predicted[0, 4:, 1, 0] = bad
    trajectories = labelled_trajectories(scene, window, predicted)
    assert trajectories.frame_count == 6
    assert trajectories.title == "The prediction is not finite from frame 6 on"
    assert labelled_trajectories(scene, window, truth[:, 2:]).title == ""
