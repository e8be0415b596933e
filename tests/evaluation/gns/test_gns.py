"""The particle-graph baseline: its graph, symmetries, training on a motion it can learn, and its files."""

import dataclasses
import json

import pytest
import torch

from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import Recording
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.gns import (
    GraphRecipe,
    GraphTrainer,
    GraphTraining,
    TrainedGraph,
    is_graph_folder,
    radius_graph,
    read_graph,
    read_progress,
    train,
    write_graph,
    write_progress,
)
from nmpm.evaluation.gns.simulator import Surroundings, extend_back
from nmpm.evaluation.gns.training import loss_of, window_at
from nmpm.scene import Scene

SCENE = Scene(
    bounds=((-100.0, 100.0),) * 2, domain=((-101.0, 101.0),) * 2, dt=0.1, materials=("water",), particle_volume=1e-2
)


@pytest.fixture
def simulator():
    torch.manual_seed(0)
    return GraphRecipe(SCENE, width=16, steps=3).build().eval()


def random_history(count=40, frames=6, seed=0):
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand(count, 1, 2, generator=generator)
    return start + 0.02 * torch.rand(count, frames, 2, generator=generator)


def around(count, obstacles=0):
    return Surroundings(torch.zeros(count, dtype=torch.int64), torch.zeros(obstacles, 2), torch.zeros(2))


def falling(frames=30, count=9, pull=1e-3):
    """A block in free fall, one step of velocity each frame."""
    axis = 0.1 * torch.arange(3.0)
    start = torch.cartesian_prod(axis, axis)[:count]
    time = torch.arange(frames).view(-1, 1, 1)
    path = start - torch.tensor([0.0, pull / 2]) * time**2 + torch.tensor([0.01, 0.0]) * time
    return Recording(path, torch.zeros(count, dtype=torch.int64), torch.zeros(0, 2), torch.zeros(2))


@pytest.mark.parametrize("dim", [2, 3])
def test_the_radius_graph_is_that_of_all_distances(dim):
    position = torch.rand(60, dim, generator=torch.Generator().manual_seed(dim))
    near = (torch.cdist(position.double(), position.double()) <= 0.2) & ~torch.eye(60, dtype=torch.bool)
    found = torch.zeros_like(near)
    sender, receiver = radius_graph(position, 0.2)
    found[sender, receiver] = True
    assert torch.equal(found, near)
    assert len(sender) == int(near.sum())  # none is listed twice


def test_lone_particles_have_no_edges_and_wrong_positions_are_refused():
    assert radius_graph(torch.tensor([[0.0, 0.0], [1.0, 0.0]]), 0.5).shape == (2, 0)
    with pytest.raises(DataError, match="not finite"):
        radius_graph(torch.tensor([[0.0, float("nan")]]), 0.5)
    with pytest.raises(DataError, match="collapsed"):
        radius_graph(torch.zeros(300, 2), 0.5)


def test_predictions_do_not_depend_on_the_place(simulator):
    history, shift = random_history(), torch.tensor([0.5, -0.25])  # far from all walls
    moved = simulator.advance(history + shift, around(40))
    torch.testing.assert_close(moved, simulator.advance(history, around(40)) + shift, atol=1e-5, rtol=0)


def test_predictions_do_not_depend_on_the_order(simulator):
    history, order = random_history(), torch.randperm(40, generator=torch.Generator().manual_seed(3))
    expected = simulator.advance(history, around(40))[order]
    torch.testing.assert_close(simulator.advance(history[order], around(40)), expected, atol=1e-5, rtol=0)


def test_messages_travel_as_far_as_there_are_steps(simulator):
    line = torch.stack([0.15 * torch.arange(8.0), torch.zeros(8)], dim=-1)  # each sees its neighbours
    history = line.unsqueeze(1).repeat(1, 6, 1)
    kicked = history.clone()
    kicked[0, :-1, 0] -= 0.01  # it came in faster
    change = (simulator(kicked, around(8)) - simulator(history, around(8))).abs().sum(-1) > 1e-9
    assert change.tolist() == [True] * 4 + [False] * 4


def test_walls_and_obstacles_are_seen_within_the_radius():
    box = dataclasses.replace(SCENE, bounds=((0.0, 10.0),) * 2, domain=((0.0, 10.0),) * 2, obstacles=True)
    simulator = GraphRecipe(box, width=8, steps=1).build().eval()
    middle, below = (torch.tensor([[5.0, y]]).unsqueeze(1).repeat(1, 6, 1) for y in (5.0, 0.1))
    free = simulator(middle, around(1))
    assert torch.equal(free, simulator(middle - 1.0, around(1)))  # both far from everything
    assert not torch.allclose(free, simulator(below, around(1)))
    near, far = (dataclasses.replace(around(1), obstacle=torch.tensor([[5.0 + x, 5.0]])) for x in (0.1, 1.0))
    torch.testing.assert_close(simulator(middle, far), free)
    assert not torch.allclose(free, simulator(middle, near))


def test_what_is_before_a_recording_moved_as_it_began():
    frames = torch.tensor([[[0.0], [1.0], [3.0]]])
    assert extend_back(frames, 5).flatten().tolist() == [-2.0, -1.0, 0.0, 1.0, 3.0]
    assert extend_back(frames, 2).flatten().tolist() == [1.0, 3.0]


def test_noise_is_taken_back_by_the_acceleration_to_predict():
    recording = falling()
    clean = window_at(recording, 10, 5)
    noisy = clean.with_noise(0.01, torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        noisy.following - noisy.history[:, -1], clean.following - clean.history[:, -1], atol=1e-6, rtol=0
    )
    last = (noisy.history - clean.history).diff(dim=1)[:, -1]
    torch.testing.assert_close(noisy.acceleration, clean.acceleration - last, atol=1e-6, rtol=0)
    many = [clean.with_noise(0.01, torch.Generator().manual_seed(seed)).history for seed in range(300)]
    spread = (torch.stack(many) - clean.history).diff(dim=2)[:, :, -1].std()
    assert 0.009 < float(spread) < 0.011


def test_it_overfits_free_fall():
    torch.manual_seed(0)
    recording = falling()
    simulator = GraphRecipe(SCENE, width=16, steps=2).build()
    steps = iter(range(10**6))  # a clock that counts, whatever the machine's speed
    settings = GraphTraining(seconds=150, noise=0.0, batch=1, rate=3e-3)
    list(train(simulator, [recording], settings, clock=lambda: next(steps)))
    state = collate([recording], SCENE, 2).initial
    predicted = simulator.rollout(state, 20)[0]
    error = (predicted - recording.frames[2:22]).abs().max()
    straight = (recording.frames[2:22] - (recording.frames[1] + 0)).abs().max()
    assert float(error) < 0.05 * float(straight)


def test_a_rollout_starts_over_for_each_scene_and_leaves_padding(simulator):
    short, long = falling(count=4), falling(count=9)
    both = collate([short, long], SCENE, 2).initial
    together = simulator.rollout(both, 3)
    for index, recording in enumerate((short, long)):
        alone = simulator.rollout(collate([recording], SCENE, 2).initial, 3)
        torch.testing.assert_close(together[index, :, both.mask[index]], alone[0])
    assert torch.equal(together[0, 2, ~both.mask[0]], both.position[0, ~both.mask[0]])


def test_files_hold_simulator_and_training(simulator, tmp_path):
    curve = ((1.0, 0.5), (2.0, 0.49), (4.0, 0.4))
    write_graph(tmp_path, TrainedGraph(simulator, 4.0, 100, curve))
    assert is_graph_folder(tmp_path)
    again = read_graph(tmp_path)
    assert (again.minutes, again.steps, again.curve) == (4.0, 100, curve)
    window = window_at(falling(), 7, 5)
    assert torch.equal(loss_of(again.simulator, window), loss_of(simulator, window))


def test_what_has_not_converged_is_named_so(simulator):
    falls, steady = ((2.0, 0.5), (4.0, 0.4)), ((2.0, 0.402), (4.0, 0.4))
    assert TrainedGraph(simulator, 4.0, 1, falls).label == "GNS, 4 min of training, not converged"
    assert TrainedGraph(simulator, 4.0, 1, steady).label == "GNS, 4 min of training"
    assert not TrainedGraph(simulator, 4.0, 1, ((4.0, 0.4),)).converged  # nobody knows


def test_damaged_files_are_named(simulator, tmp_path):
    write_graph(tmp_path, TrainedGraph(simulator, 1.0, 1, ((1.0, 0.5),)))
    facts = json.loads((tmp_path / "gns.json").read_text())
    facts["recipe"]["width"] = 8
    (tmp_path / "gns.json").write_text(json.dumps(facts))
    with pytest.raises(DataError, match=r"model\.safetensors does not fit"):
        read_graph(tmp_path)
    (tmp_path / "gns.json").write_text("{}")
    with pytest.raises(DataError, match="describes no graph simulator"):
        read_graph(tmp_path)


def test_wrong_settings_are_named():
    with pytest.raises(ConfigError, match="width = 0"):
        GraphRecipe(SCENE, width=0)
    with pytest.raises(ConfigError, match="not for periodic axes"):
        GraphRecipe(
            dataclasses.replace(SCENE, boundary=("periodic", "wall"), domain=(SCENE.bounds[0], SCENE.domain[1]))
        )
    with pytest.raises(ConfigError, match="read no fields, and the scene has heat"):
        GraphRecipe(dataclasses.replace(SCENE, evolving=("heat",)))
    with pytest.raises(ConfigError, match="seconds = 0"):
        GraphTraining(0)


def counting_trainer():
    torch.manual_seed(0)
    steps = iter(range(10**6))
    settings = GraphTraining(seconds=8, noise=1e-3, batch=2)
    return GraphTrainer(GraphRecipe(SCENE, width=4, steps=1).build(), [falling()], settings, lambda: next(steps))


def test_a_training_that_was_stored_ends_with_the_weights_of_an_uninterrupted_one(tmp_path):
    whole, first, second = counting_trainer(), counting_trainer(), counting_trainer()
    while not whole.done:
        whole.step()
    for _ in range(3):
        first.step()
    write_progress(tmp_path / "training.safetensors", first.state_dict(), [(1.0, 0.5)])
    state, curve = read_progress(tmp_path / "training.safetensors")
    assert curve == [(1.0, 0.5)]
    second.load_state_dict(state)
    while not second.done:
        second.step()
    assert (second.steps, second.spent) == (whole.steps, whole.spent) == (8, 8.0)
    for name, values in whole.simulator.state_dict().items():
        assert torch.equal(second.simulator.state_dict()[name], values), name


def test_stored_trainings_of_others_are_refused(tmp_path):
    path = tmp_path / "training.safetensors"
    path.write_bytes(b"nothing")
    with pytest.raises(DataError, match="is no state of a training"):
        read_progress(path)
    with pytest.raises(DataError, match="not of this training"):
        counting_trainer().load_state_dict({"simulator.network": torch.zeros(1)})
