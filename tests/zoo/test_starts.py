"""States taken out of recorded trajectories."""

import dataclasses

import numpy as np
import pytest
import torch
from scenes import box

from nmpm.data.format import Trajectory
from nmpm.data.metadata import scene_metadata
from nmpm.errors import ConfigError, DataError
from tests.zoo.test_states import model_of

SCENE = box(materials=("water", "sand"), obstacles=True)
TYPES = {0: "sand", 1: "water", 2: "wall"}


def recorded(metadata=None, **changes) -> Trajectory:
    rng = np.random.default_rng(0)
    position = rng.uniform(0.3, 0.7, (1, 6, 2)) + np.zeros((5, 1, 1))
    position[:, :4, 0] += 0.002 * np.arange(5)[:, None]
    position[2, 1] = np.nan
    metadata = metadata or scene_metadata(SCENE, TYPES, 2)
    return Trajectory(position, np.array([0, 0, 1, 1, 2, 2]), metadata=dataclasses.replace(metadata, **changes))


@pytest.fixture
def model():
    return model_of(SCENE)


def test_obstacles_and_absent_particles_are_taken_apart(model):
    trajectory = recorded(gravity=(0.0, -9.7))  # as measured
    state = model.start(trajectory, frame=3)
    assert state.position.shape == (1, 3, 2)  # particle 1 was absent in frame 2
    np.testing.assert_array_equal(state.position[0], trajectory.position[3, [0, 2, 3]])
    torch.testing.assert_close(state.velocity[0, :, 0], torch.full((3,), 0.002), atol=1e-6, rtol=0)
    assert state.material.tolist() == [[1, 0, 0]]
    np.testing.assert_array_equal(state.obstacle[0], trajectory.position[3, 4:])
    assert model.rollout(state, 2).shape == (1, 2, 3, 2)


def test_data_of_another_time_step_have_the_same_velocity_in_seconds(model):
    state = model.start(recorded(dt=2 * SCENE.dt), frame=1)
    torch.testing.assert_close(state.velocity[0, :, 0], torch.full((4,), 0.001), atol=1e-6, rtol=0)


def test_fields_and_sizes_of_particles_are_taken_along():
    model = model_of(dataclasses.replace(SCENE, evolving=("heat",), parameters=("angle",)))
    heat, radius = np.arange(30.0).reshape(5, 6), np.array([1.0, 1.0, 2.0, 2.0, 1.0, 1.0])
    trajectory = dataclasses.replace(recorded(), fields={"heat": heat, "radius": radius}, attributes={"angle": 0.5})
    state = model.start(trajectory, frame=4)
    assert state.fields["heat"].tolist() == [heat[4, :4].tolist()]
    assert state.fields["angle"].tolist() == [[0.5]]
    torch.testing.assert_close(state.volume, torch.tensor([[0.4, 0.4, 1.6, 1.6]]))


def test_materials_of_other_names_are_refused_unless_stated(model):
    trajectory = recorded(particle_types={0: "sand", 1: "watr", 2: "wall"})
    with pytest.raises(DataError, match=r"has watr, the model water, sand\. Did you mean water\?.*materials="):
        model.start(trajectory)
    assert model.start(trajectory, materials={"watr": "water"}).material.tolist() == [[1, 1, 0, 0]]
    bare = dataclasses.replace(trajectory, metadata=None)
    with pytest.raises(DataError, match=r"does not say what its particle types \[0, 1, 2\] are"):
        model.start(bare)
    only = Trajectory(bare.position[:, :1], np.array([7]))
    assert model_of(box()).start(only).material.tolist() == [[0]]


def test_frames_and_gravity_that_do_not_fit_are_refused(model):
    for frame in (0, 5, -1):
        with pytest.raises(ConfigError, match=rf"frame = {frame} must be 1 … 4"):
            model.start(recorded(), frame)
    with pytest.raises(DataError, match="the model knows only"):
        model.start(recorded(gravity=(0.0, 9.81)))


@pytest.mark.parametrize("ratio", [1 / 4, 1 / 2, 2, 3])
@pytest.mark.parametrize("frame", [1, 2, 7])
def test_a_free_fall_starts_exactly_in_a_model_of_other_frames(ratio, frame):
    scene = dataclasses.replace(SCENE, dt=SCENE.dt * ratio)
    finer = 4 * np.arange(9)[:, None, None]  # frames of a clock of which one of the data has four
    gravity = np.array([0.0, -9.81]) * (SCENE.dt / 4) ** 2
    thrown = np.random.default_rng(0).normal(scale=2e-4, size=(1, 6, 2))

    def fallen(n):
        return 0.5 + 0.01 * np.arange(6)[:, None] + thrown * n + gravity * n * (n + 1) / 2

    metadata = scene_metadata(SCENE, TYPES, 2)
    trajectory = Trajectory(fallen(finer), np.array([0, 0, 1, 1, 0, 0]), metadata=metadata)
    state = model_of(scene).start(trajectory, frame)
    exact = fallen(4 * frame) - fallen(4 * frame - 4 * ratio)
    np.testing.assert_allclose(state.velocity[0], exact[0], rtol=0, atol=1e-6)


def test_a_match_knows_the_names_of_the_materials(model):
    trajectory = recorded(particle_types={0: "grit", 1: "brine", 2: "wall"})
    foreign = dataclasses.replace(SCENE, materials=("grit", "brine"))
    matched = model.fit_to(foreign, {"grit": "sand", "brine": "water"})
    assert matched.start(trajectory).material.tolist() == [[1, 1, 0, 0]]
    assert matched.start(trajectory, materials={"grit": "water"}).material.tolist() == [[0, 0, 0, 0]]
