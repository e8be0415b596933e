"""What all runtimes share, and CUDA graphs with a stand-in for the GPU's recorder."""

import copy
import pickle
import warnings

import pytest
import torch

from nmpm.emulator import Emulator, rollout
from nmpm.emulator.runtimes import RUNTIMES, CudaGraph, Eager, cuda_graph, find_runtime, runtime
from nmpm.emulator.runtimes.programs import Programs
from nmpm.errors import ConfigError
from nmpm.transfer import scatter_backend, without_kernels
from tests.scenes import box, cloud, emulator_of


def small(scene=None, **constraints) -> Emulator:
    return emulator_of(scene or box(), 8, 3, **constraints).requires_grad_(False)


def test_a_runtime_is_found_by_name_and_another_is_refused_with_the_known_ones():
    assert {name: type(find_runtime(name)) for name in RUNTIMES} == dict(RUNTIMES)
    assert list(RUNTIMES)[-1] == "eager"
    with pytest.raises(ConfigError, match=r"No runtime is called 'openvin'.*cuda-graph.*Did you mean openvino\?"):
        small().with_runtime("openvin")
    with pytest.raises(ConfigError, match="needs a CUDA GPU; the model is on cpu"):
        small().with_runtime("cuda-graph")


def test_torch_in_bfloat16_without_instructions_for_it_warns(monkeypatch):
    monkeypatch.setattr(runtime, "computes_bfloat16", lambda device: device.type != "cpu")
    with pytest.warns(UserWarning, match="no instructions for bfloat16: torch is slower in it than in float32"):
        small().with_network(torch.bfloat16)(cloud(box()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small()(cloud(box()))


@pytest.mark.parametrize(
    "change",
    [
        lambda network: network.weight.add_(1),
        lambda network: network.load_state_dict({"weight": torch.ones(2, 2), "bias": torch.ones(2)}),
        lambda network: network.load_state_dict({"weight": torch.ones(2, 2), "bias": torch.ones(2)}, assign=True),
        lambda network: network.bfloat16().float(),
        lambda network: setattr(network, "bias", None),
    ],
)
@torch.no_grad()
def test_changed_weights_are_compiled_again(change):
    programs, network = Programs(), torch.nn.Linear(2, 2)

    def find() -> list[torch.Tensor]:
        """The program, which is a list that knows the weights at the time when it was made."""
        return programs.find(network, 0, lambda: [weight.clone() for weight in network.parameters()])

    before = find()
    change(network)
    after = find()
    assert after is not before
    assert all(map(torch.equal, after, network.parameters()))
    assert find() is after


# ---- CUDA graphs


@pytest.fixture
def replayed(monkeypatch):
    """A list of the bundles replayed by the runtime "cuda-graph", whose recorder runs the function again, in place."""

    def record(function, _):
        result = function()

        def replay():
            bundles.append(result)
            again = function()
            result.position.copy_(again.position)
            result.velocity.copy_(again.velocity)

        return replay, result

    bundles = []
    monkeypatch.setattr(CudaGraph, "unsupported_reason", lambda *_: "")
    monkeypatch.setattr(cuda_graph, "record", record)
    return bundles


@pytest.mark.parametrize(("energy", "obstacles"), [(False, False), (True, True)])
def test_replayed_bundles_are_those_of_torch(replayed, energy, obstacles):
    scene = box(obstacles=obstacles, materials=("water", "sand"))
    emulator = small(scene, energy=energy)
    quick = emulator.with_runtime("cuda-graph")
    for seed, count in ((0, 30), (1, 30), (2, 40), (3, 30)):
        state = cloud(scene, count, batch=2, seed=seed, statics=5 * obstacles)
        assert torch.equal(rollout(quick, state, 6), rollout(emulator, state, 6))
    shapes = {tuple(bundle.position.shape) for bundle in replayed}
    assert len(replayed) == 8
    assert len({id(bundle) for bundle in replayed}) == len(shapes) == 2


@pytest.mark.usefixtures("replayed")
def test_a_replay_leaves_earlier_bundles_alone():
    quick = small().with_runtime("cuda-graph")
    first = quick(cloud(box()))
    before = first.position.clone(), first.velocity.clone()
    quick(cloud(box(), seed=1))
    assert torch.equal(first.position, before[0])
    assert torch.equal(first.velocity, before[1])


def test_chosen_backends_and_autocast_are_not_recorded_and_gradients_refused(replayed):
    quick, state = small().with_runtime("cuda-graph"), cloud(box())
    with without_kernels(), scatter_backend("sorted"):
        quick(state)
    with torch.autocast("cpu", torch.bfloat16):
        quick(state)
    assert replayed == []
    state.velocity.requires_grad_()
    with pytest.raises(ConfigError, match=r"cuda-graph has no gradients.*with_runtime\(\"eager\"\)"):
        quick(state)


@pytest.mark.usefixtures("replayed")
def test_copies_keep_the_runtime_and_share_no_programs():
    quick = small().with_runtime("cuda-graph")
    expected = quick(cloud(box())).position
    for other in (copy.deepcopy(quick), pickle.loads(pickle.dumps(quick)), quick.over(quick.scene)):  # noqa: S301
        assert isinstance(other.runtime, CudaGraph)
        assert other.runtime is not quick.runtime
        assert torch.equal(other(cloud(box())).position, expected)
    assert quick.unconstrained().runtime is quick.runtime
    assert isinstance(quick.with_runtime("eager").runtime, Eager)
