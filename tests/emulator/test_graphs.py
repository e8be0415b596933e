"""Calls on a GPU are recorded as CUDA graphs, here with a stand-in for the recorder."""

import copy
import pickle
import warnings

import pytest
import torch

from nmpm.emulator import Emulator, rollout
from nmpm.emulator.engines import graphs
from nmpm.emulator.rollouts import predict_rollout
from nmpm.transfer import scatter_backend, without_kernels
from tests.scenes import box, cloud, emulator_of


def small(scene=None, **constraints) -> Emulator:
    return emulator_of(scene or box(), 8, 3, **constraints).requires_grad_(False)


@pytest.fixture
def replayed(monkeypatch):
    """A list of the recordings that are replayed; the recorder runs the function again, in place, as if on a GPU."""

    def record(function, _):
        result = function()

        def replay():
            bundles.append(result)
            again = function()
            result.position.copy_(again.position)
            result.velocity.copy_(again.velocity)
            for name, values in result.fields.items():
                values.copy_(again.fields[name])

        return replay, result

    bundles = []
    monkeypatch.setattr(graphs, "RECORDINGS", graphs.RECORDINGS[1:])
    monkeypatch.setattr(graphs, "record", record)
    return bundles


SCENES = {
    "plain": (box(), {}),
    "constraints": (box(obstacles=True, materials=("water", "sand")), {"energy": True}),
    "a temperature": (box(evolving=("heat",)), {}),
}


@pytest.mark.parametrize("name", SCENES)
def test_replayed_bundles_are_those_of_torch_from_the_second_call_of_a_shape(replayed, name):
    scene, constraints = SCENES[name]
    plain = small(scene, **constraints)
    recorded = copy.deepcopy(plain)
    for seed, count in ((0, 30), (1, 30), (2, 40), (3, 30)):
        state = cloud(scene, count, batch=2, seed=seed, statics=5 * scene.obstacles)
        if scene.evolving:
            state = state.with_fields({"heat": torch.rand(2, count)})
        predicted = predict_rollout(recorded, state, 6)
        with without_kernels():  # operation by operation
            expected = predict_rollout(plain, state, 6)
        torch.testing.assert_close(predicted.position, expected.position, rtol=0, atol=1e-5)
        for field, values in expected.fields.items():
            torch.testing.assert_close(predicted.fields[field], values, rtol=1e-4, atol=1e-5)
    assert len(replayed) == 6  # of 8 calls, in 2 shapes
    assert len({id(bundle) for bundle in replayed}) == 2


@pytest.mark.usefixtures("replayed")
def test_a_replay_leaves_earlier_bundles_alone():
    emulator = small()
    emulator(cloud(box()))
    first = emulator(cloud(box()))
    before = first.position.clone(), first.velocity.clone()
    emulator(cloud(box(), seed=1))
    assert torch.equal(first.position, before[0])
    assert torch.equal(first.velocity, before[1])


def test_shapes_that_change_with_each_call_are_not_recorded(replayed):
    emulator = small()
    for count in range(20, 40):
        emulator(cloud(box(), count))
    assert replayed == []


def test_of_many_shapes_in_turn_a_few_are_recorded(replayed, monkeypatch):
    monkeypatch.setattr(graphs, "MOST", 2)
    emulator = small()
    for _ in range(3):
        for count in (20, 21, 22, 23):
            emulator(cloud(box(), count))
    assert len({bundle.position.shape for bundle in replayed}) == 2


def test_what_is_chosen_or_needs_gradients_is_computed_operation_by_operation(replayed):
    emulator, state = small(), cloud(box())
    for _ in range(3):
        with without_kernels(), scatter_backend("sorted"):
            emulator(state)
        with torch.autocast("cpu", torch.bfloat16):
            emulator(state)
        small(bounds="error")(state)
        emulator.with_runtime("windows")(state)
        emulator.train()(state)
        emulator.eval()
    moving = cloud(box())
    moving.velocity.requires_grad_()
    for _ in range(3):
        emulator(moving).position.sum().backward()
    assert replayed == []
    assert moving.velocity.grad.isfinite().all()


def test_recordings_in_inference_mode_serve_calls_outside(replayed):
    emulator, state = small(), cloud(box())
    with torch.inference_mode():
        inside = [emulator(state).position for _ in range(3)]
    outside = emulator(state).position
    assert all(torch.equal(position, outside) for position in inside)
    assert len(replayed) == 3


def test_changed_weights_are_recorded_again_and_copies_for_themselves(replayed):
    emulator, state = small(), cloud(box())
    for _ in range(2):
        before = emulator(state).position
    for other in (copy.deepcopy(emulator), pickle.loads(pickle.dumps(emulator)), emulator.over(emulator.scene)):  # noqa: S301
        assert torch.equal(other(state).position, before)
    assert len(replayed) == 1
    with torch.no_grad():
        for weight in emulator.processor.parameters():
            weight.add_(0.1)
    after = emulator(state).position
    assert not torch.equal(after, before)
    with without_kernels():
        torch.testing.assert_close(after, emulator(state).position, rtol=0, atol=1e-5)


def test_what_cannot_be_recorded_is_said_once(replayed, monkeypatch):
    monkeypatch.setattr(graphs, "record", lambda *_: 1 / 0)
    emulator, state = small(), cloud(box())
    expected = emulator(state).position
    with pytest.warns(UserWarning, match="Calls are not recorded as CUDA graphs: division by zero"):
        assert torch.equal(emulator(state).position, expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(rollout(emulator, state, 3), expected)
    assert replayed == []


def test_a_training_frees_the_recordings(replayed):
    emulator, state = small(), cloud(box())
    for _ in range(3):
        emulator(state)
    before, recordings = len(replayed), emulator.recorded_calls
    emulator.train().eval()(state)
    assert len(replayed) == before > 0
    assert emulator.recorded_calls is not recordings
