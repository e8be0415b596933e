"""What all runtimes share."""

import warnings

import pytest
import torch

from nmpm.backends import FORMER, RUNTIMES
from nmpm.emulator import Emulator
from nmpm.emulator.runtimes import Eager, find_runtime, runtime
from nmpm.emulator.runtimes.runtime import Programs
from nmpm.errors import ConfigError
from tests.scenes import box, cloud, emulator_of


def small(scene=None, **constraints) -> Emulator:
    return emulator_of(scene or box(), 8, 3, **constraints).requires_grad_(False)


def test_a_runtime_is_found_by_name_and_another_is_refused_with_the_known_ones():
    assert all(find_runtime(name).name == name for name in RUNTIMES)
    with pytest.raises(ConfigError, match=r"There is no runtime 'openvin'.*windows, eager.*Did you mean openvino\?"):
        small().with_runtime("openvin")


@pytest.mark.parametrize("name", FORMER)
def test_a_former_name_is_understood(name):
    with pytest.warns(UserWarning, match=f"The runtime {name} is now part of eager, the default: on a CUDA GPU"):
        assert isinstance(small().with_runtime(name).runtime, Eager)


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
