"""Particles that come and go, and obstacles that move, in files of predictions and in pictures."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from nmpm.data.format import Split, write_split
from nmpm.data.predictions import predicted_trajectory
from nmpm.emulator import Prescribed, RolloutOptions, rollout
from nmpm.errors import DataError
from nmpm.evaluation.pictures import labelled_trajectories
from nmpm.particles import Window
from nmpm.viz import write_animation, write_snapshots
from nmpm.viz.files import combine, read_labelled
from nmpm.viz.page import ABSENT, quantize
from nmpm.viz.panel import PanelRenderer
from nmpm.viz.viewer import ViewerPage
from tests.scenes import box, cloud, emulator_of, silenced, with_obstacle

SCENE = box(obstacles=True, moving_obstacles=True, gravity=(0.0, 0.0))
FRAMES = 8


@pytest.fixture
def window() -> Window:
    """Five particles, of which the third comes in frame 3 and the fourth goes after frame 5, beside a paddle."""
    state = with_obstacle(cloud(SCENE, 5), torch.tensor([[0.2, 0.5], [0.2, 0.52]]))
    steps = torch.arange(-1, FRAMES + 1).view(1, -1, 1, 1)
    present = torch.ones(1, FRAMES + 2, 5, dtype=torch.bool)
    present[0, :3, 2] = present[0, 6:, 3] = False
    frames = state.position.unsqueeze(1) + steps * state.velocity.unsqueeze(1)
    obstacle = state.obstacle.unsqueeze(1) + 0.002 * steps
    return dataclasses.replace(Window.of(state), frames=frames, present=present, obstacle_frames=obstacle)


@pytest.fixture
def predicted(window) -> torch.Tensor:
    emulator = silenced(emulator_of(SCENE, frames=4)).requires_grad_(False)
    return rollout(emulator, window.initial, FRAMES, RolloutOptions(Prescribed.of(window)))


@pytest.fixture
def file(window, predicted, tmp_path):
    path = tmp_path / "out.h5"
    kept = {"truth": window.recorded, "real": window.mask, "obstacle_frames": window.obstacle_frames}
    write_split(path, [predicted_trajectory(SCENE, window.initial, predicted, "a test", **kept)])
    return path


def test_files_of_predictions_have_nan_for_the_absent_and_obstacles_where_they_move(file, window, predicted):
    trajectory = Split(file).read(0)
    assert trajectory.position.shape == (FRAMES + 2, 7, 2)
    np.testing.assert_array_equal(trajectory.position[2:, :5], predicted[0].numpy())
    assert np.isnan(trajectory.position[:6, 2]).all()
    np.testing.assert_allclose(trajectory.position[:, 5:], window.obstacle_frames[0].numpy())
    assert np.isnan(Split(file).fields(0)["truth"][:3, 2]).all()
    assert trajectory.attributes["prescribed_types"].tolist() == [2]


def test_the_absent_are_not_drawn_and_count_in_no_error(file, tmp_path):
    labelled = read_labelled(Split(file))
    assert labelled.prescribed == {"moving wall"}
    errors = labelled.rms_errors()["prediction"]
    assert np.isfinite(errors).all()
    panel = PanelRenderer(labelled, 100)
    position = labelled.positions["prediction"]
    assert panel.count_outside(position[2]) == 0
    alone = panel.draw(np.where(np.arange(7)[:, None] == 2, position[-1], np.nan))
    with_absent = panel.draw(np.where(np.arange(7)[:, None] == 2, position[2], np.nan))
    assert (alone != with_absent).any()
    write_snapshots(labelled, tmp_path / "a.png")
    write_animation(labelled, tmp_path / "a.gif", max_frames=3, side=64)
    assert re.search(r"[:\[,]NaN", ViewerPage(labelled).html) is None
    assert combine(labelled, labelled, ("one", "other")).frame_count == FRAMES + 2


def test_positions_that_are_partly_nan_are_an_error(file):
    labelled = read_labelled(Split(file))
    broken = {label: position.copy() for label, position in labelled.positions.items()}
    broken["prediction"][4, 0, 1] = np.nan
    with pytest.raises(DataError, match="particle 0 is at"):
        dataclasses.replace(labelled, positions=broken)


def test_absent_positions_have_a_number_of_their_own_in_the_viewer():
    low, high = np.zeros(2), np.ones(2)
    steps = quantize(np.array([[0.0, 1.0], [1.0, 0.5], [np.nan, np.nan]]), low, high)
    assert (steps[2] == ABSENT).all()
    assert (steps[:2] < ABSENT).all()


def test_pictures_of_a_test_end_only_where_predictions_are_broken(window, predicted):
    assert labelled_trajectories(SCENE, window, predicted).frame_count == FRAMES + 2
    broken = predicted.clone()
    broken[0, 5] = torch.nan
    assert labelled_trajectories(SCENE, window, broken).frame_count == 7
