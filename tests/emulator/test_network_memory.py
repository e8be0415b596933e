"""What a rollout's memory knows is what the network predicts, however the state changes from call to call."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box

from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.windows import Memory, Windows, choose_windows, usable_memory
from nmpm.processors import UNet

SMALL = UNet(width=4, depth=1, perceptron=(5,))  # sees 9 cells; an even number along periodic axes
ALWAYS = Windows(least_cells=1)


def emulator_of(wraps: bool, cells: int):
    scene = box(boundary=("periodic", "wall"), domain=((0.1, 0.9), (0.08, 0.92))) if wraps else box()
    torch.manual_seed(0)
    return EmulatorRecipe(scene, (cells, cells), 4, processor=SMALL).build().eval().requires_grad_(False)


@given(
    wraps=st.booleans(),
    cells=st.sampled_from([64, 74]),  # blocks of 4 cells; 2 are left over
    places=st.lists(st.tuples(st.integers(0, 73), st.integers(0, 73)), min_size=1, max_size=5),
)
@settings(max_examples=15, deadline=None)
@torch.no_grad()
def test_what_is_known_is_what_the_network_predicts(wraps, cells, places):
    emulator, memory = emulator_of(wraps, cells), Memory()
    network, state = emulator.processor, torch.zeros(1, len(emulator.scene.input_channels), cells, cells)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nmpm.emulator.windows.cover.CALL_CELLS", 10)
        patch.setattr("nmpm.emulator.windows.choice.CALL_CELLS", 10)
        for row, column in places:
            state = state.clone()
            state[0, :, row % cells, column % cells] = torch.randn(state.shape[1])
            state[0, 2, row % cells, column % cells] = 1.0  # the volume: here are particles
            coverage = choose_windows(ALWAYS, network, emulator.recipe, state, memory)
            if coverage is None:
                memory.keep(network(state))
            else:
                readable = coverage.readable.clone()
                output = coverage.predict(network, state)
                assert memory.known[readable].all()
                assert output is memory.output
            exact = network(state).movedim((1, 2), (-2, -1))
            found = memory.output.movedim((1, 2), (-2, -1))
            torch.testing.assert_close(found[memory.known], exact[memory.known], rtol=1e-4, atol=1e-5)
            assert memory.known[state[:, 2] != 0].all()


@torch.no_grad()
def test_an_unchanged_state_needs_no_network():
    emulator, memory, calls = emulator_of(False, 64), Memory(), []
    state = torch.zeros(1, len(emulator.scene.input_channels), 64, 64)
    state[0, :, 30:34, 30:34] = 1.0
    network = emulator.processor
    for _ in range(2):
        coverage = choose_windows(ALWAYS, network, emulator.recipe, state.clone(), memory)
        calls.append(None if coverage is None else len(coverage.windows))
        if coverage is None:
            memory.keep(network(state))
        else:
            coverage.predict(network, state)
    assert calls[0] != 0
    assert calls[1] == 0


def test_gradients_and_small_grids_use_no_memory():
    emulator, memory = emulator_of(False, 64), Memory()
    state = torch.zeros(1, len(emulator.scene.input_channels), 64, 64)
    assert usable_memory(memory, ALWAYS, emulator.processor, emulator.recipe, state) is None  # gradients are recorded
    with torch.no_grad():
        assert usable_memory(memory, ALWAYS, emulator.processor, emulator.recipe, state) is memory
        assert usable_memory(memory, Windows(), emulator.processor, emulator.recipe, state) is None
        assert usable_memory(memory, None, emulator.processor, emulator.recipe, state) is None
