"""What all runtimes share, and CUDA graphs with a stand-in for the GPU's recorder."""

import copy
import pickle
import warnings

import pytest
import torch
from scenes import box, cloud
from torch.utils._python_dispatch import TorchDispatchMode

from nmpm.emulator import Emulator, EmulatorRecipe, rollout
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.runtimes import RUNTIMES, CudaGraph, Eager, cuda_graph, find_runtime, runtime
from nmpm.emulator.runtimes.programs import Programs
from nmpm.errors import ConfigError
from nmpm.processors import Pointwise, UNet
from nmpm.transfer import Linear, Quadratic, scatter_backend, without_kernels


def emulator_of(scene=None, processor=Pointwise(hidden=(6,)), transfer=Linear(), **constraints) -> Emulator:
    torch.manual_seed(0)
    held = Constraints(**constraints)
    recipe = EmulatorRecipe(scene or box(), 8, 3, transfer, processor, constraints=held)
    return recipe.build().eval().requires_grad_(False)


# ---- by name


def test_a_runtime_is_found_by_name_and_another_is_refused_with_the_known_ones():
    assert {name: type(find_runtime(name)) for name in RUNTIMES} == dict(RUNTIMES)
    assert list(RUNTIMES)[-1] == "eager"
    with pytest.raises(ConfigError, match=r"No runtime is called 'openvin'.*cuda-graph.*Did you mean openvino\?"):
        emulator_of().with_runtime("openvin")
    with pytest.raises(ConfigError, match="needs a CUDA GPU; the model is on cpu"):
        emulator_of().with_runtime("cuda-graph")


def test_torch_in_bfloat16_without_instructions_for_it_warns(monkeypatch):
    monkeypatch.setattr(runtime, "computes_bfloat16", lambda device: device.type != "cpu")
    with pytest.warns(UserWarning, match="no instructions for bfloat16: torch is slower in it than in float32"):
        emulator_of().with_network(torch.bfloat16)(cloud(box()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        emulator_of()(cloud(box()))


# ---- programs


def find(programs: Programs, network, settings=0) -> list:
    """The program, which is a list that knows the weights at the time when it was made."""
    return programs.find(network, settings, lambda: [weight.clone() for weight in network.parameters()])


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
    before = find(programs, network)
    change(network)
    after = find(programs, network)
    assert after is not before
    assert all(torch.equal(own, weight) for own, weight in zip(after, network.parameters(), strict=True))
    assert find(programs, network) is after


# ---- CUDA graphs


@pytest.fixture
def graphed(monkeypatch):
    """Turns an emulator to CUDA graphs whose recorder only runs the function again, into the same memory."""

    def record(function, _):
        result = function()

        def replay():
            recorded.append(result)
            again = function()
            result.position.copy_(again.position)
            result.velocity.copy_(again.velocity)

        return replay, result

    def turn(emulator: Emulator) -> Emulator:
        return emulator.with_runtime("cuda-graph")

    recorded = turn.recorded = []
    monkeypatch.setattr(CudaGraph, "unsupported_reason", lambda *_: "")
    monkeypatch.setattr(cuda_graph, "record", record)
    return turn


@pytest.mark.parametrize(("energy", "obstacles"), [(False, False), (True, True)])
def test_replayed_bundles_are_those_of_torch(graphed, energy, obstacles):
    scene = box(obstacles=obstacles, materials=("water", "sand"))
    emulator = emulator_of(scene, energy=energy)
    quick = graphed(emulator)
    for seed, count in ((0, 30), (1, 30), (2, 40), (3, 30)):
        state = cloud(scene, count, batch=2, seed=seed, statics=5 * obstacles)
        assert torch.equal(rollout(quick, state, 6), rollout(emulator, state, 6))
    shapes = {tuple(bundle.position.shape) for bundle in graphed.recorded}
    assert len(graphed.recorded) == 8
    assert len({id(bundle) for bundle in graphed.recorded}) == len(shapes) == 2


def test_a_replay_leaves_earlier_bundles_alone(graphed):
    quick, state = graphed(emulator_of()), cloud(box())
    first = quick(state)
    before = first.position.clone(), first.velocity.clone()
    quick(cloud(box(), seed=1))
    assert torch.equal(first.position, before[0])
    assert torch.equal(first.velocity, before[1])


def test_chosen_backends_and_autocast_are_not_recorded(graphed):
    quick, state = graphed(emulator_of()), cloud(box())
    with without_kernels(), scatter_backend("sorted"):
        quick(state)
    with torch.autocast("cpu", torch.bfloat16):
        quick(state)
    assert graphed.recorded == []


def test_cuda_graphs_have_no_gradients(graphed):
    quick, state = graphed(emulator_of()), cloud(box())
    state.velocity.requires_grad_()
    with pytest.raises(ConfigError, match=r"cuda-graph has no gradients.*with_runtime\(\"eager\"\)"):
        quick(state)


class WatchCopies(TorchDispatchMode):
    """Raises where an operation has tensors of the CPU and of the device, which a graph cannot record."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        tensors = [value for value in (*args, out) if isinstance(value, torch.Tensor)]
        assert len({value.device.type for value in tensors}) < 2, f"{function} copies between host and device"
        return out


@pytest.mark.parametrize("transfer", [Linear(), Quadratic()], ids=lambda part: type(part).__name__)
@pytest.mark.parametrize("obstacles", [False, True])
def test_a_bundle_copies_nothing_between_host_and_device(transfer, obstacles):
    """On torch's meta device, a stand-in for a GPU."""
    scene = box(obstacles=obstacles, materials=("water", "sand"))
    network = UNet(width=4, depth=1, perceptron=(4,))
    emulator = emulator_of(scene, network, transfer, energy=True, rest_speed=0.01, density_cap=2.0).to("meta")
    state = cloud(scene, batch=2, statics=5 * obstacles).to("meta")
    context = emulator.context(state)
    with torch.no_grad(), WatchCopies():
        emulator.predict(state, context)
    with pytest.raises(AssertionError, match="copies between host and device"), WatchCopies():
        torch.ones(2).to("meta")


# ---- emulators


def test_copies_keep_the_runtime_and_share_no_programs(graphed):
    quick = graphed(emulator_of())
    quick(cloud(box()))
    others = [copy.deepcopy(quick), pickle.loads(pickle.dumps(quick)), quick.over(quick.scene)]  # noqa: S301
    for other in others:
        assert isinstance(other.runtime, CudaGraph)
        assert other.runtime is not quick.runtime
        assert torch.equal(other(cloud(box())).position, quick(cloud(box())).position)
    assert quick.unconstrained().runtime is quick.runtime
    assert isinstance(quick.with_runtime("eager").runtime, Eager)
