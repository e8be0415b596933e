"""The network's output for a call, of the whole grid or of windows around the particles."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from torch import Tensor

from nmpm.emulator.windows import Coverage, choose_windows, find_in_windows, usable_memory

if TYPE_CHECKING:
    from nmpm.emulator.bundle import RolloutContext
    from nmpm.emulator.model import Emulator

T = TypeVar("T")


def with_output(
    emulator: Emulator,
    state: Tensor,
    normalised: Tensor,
    context: RolloutContext,
    find: Callable[[Tensor, Tensor | None], T],
) -> T:
    """What `find` gives of the network's output (B, m, C_out, *S), and of the cells (B, *S) that may be read in it.

    No cells are given, but None, where the network has run on the whole grid.

    Args:
        emulator: Whose network runs.
        state: (B, C_in, *S) in grid units.
        normalised: The same, as the network takes it.
        context: Of the rollout.
        find: Raises UncoveredReadError if it reads other cells; it is then called with more of them.
    """
    network, runtime, precision = emulator.processor, emulator.runtime, emulator.network_precision
    windows = memory = None
    if not (emulator.training or runtime.fixed_shapes):
        memory = usable_memory(context.memory, emulator.windows, network, emulator.recipe, state)
        windows = choose_windows(emulator.windows, network, emulator.recipe, state, memory)

    def find_in(coverage: Coverage | None) -> T:
        if coverage is not None:
            return find(coverage.predict(network, normalised.to(precision)), coverage.readable)
        output = runtime.fields(network, normalised, precision)
        if memory is not None:
            memory.keep(output)
        return find(output, None)

    return find_in_windows(windows, find_in)
