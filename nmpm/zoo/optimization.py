"""Faster runtimes for trained models, compared with torch's own results before they are used."""

from __future__ import annotations

import dataclasses
import logging
import time

import torch
from torch import Tensor

from nmpm.emulator import Emulator
from nmpm.emulator.rollouts import rollout
from nmpm.emulator.runtimes import RUNTIMES, Eager, Runtime, check_runtime
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.zoo.states import thrown_state

AUTO = "auto"
"""Stands for the fastest of `RUNTIMES` that can run the model here, as measured."""
TOLERANCE = 1e-3
"""Cells by which positions after one bundle may differ from torch's in float32."""
_EXAMPLE = 300  # particles of the example by which runtimes are compared
_SPEED = 0.2  # cells per frame, of the particles of the example: at rest, the network would have little to say
_BUNDLES, _ROUNDS = 4, 3  # of the rollouts that are timed
_LOG = logging.getLogger(__name__)


def fitting_count(emulator: Emulator, count: int, blocks: int | None = None) -> int:
    """The number of particles, halved until so many thrown blocks of them fit into the box."""
    try:
        thrown_state(emulator, 0, count, blocks)
    except ConfigError:
        return fitting_count(emulator, count // 2, blocks) if count > 1 else count
    return count


def small_example(emulator: Emulator) -> Particles:
    """The state by which runtimes are compared."""
    return thrown_state(emulator, 0, fitting_count(emulator, _EXAMPLE)).to(emulator.device)


def optimize(emulator: Emulator, runtime: str | Runtime) -> Emulator:
    """The emulator with another runtime, compared with torch on an example.

    Args:
        emulator: In evaluation mode.
        runtime: One of `RUNTIMES`, or its name, or "auto".

    Raises:
        ConfigError: if there is no such runtime, it cannot run the model here, or its results differ from torch's;
            "auto" leaves such a runtime out.
    """
    if isinstance(runtime, str):
        check_runtime(runtime, (AUTO, *RUNTIMES))
    if runtime != AUTO:
        return _checked(emulator, runtime)
    fitting = []
    for name in (name for name, kind in RUNTIMES.items() if kind.automatic):
        try:
            fitting.append(_checked(emulator, name))
        except ConfigError as error:
            _LOG.info("%s", error)
    if len(fitting) == 1:
        return fitting[0]
    seconds = {faster.runtime.name: _seconds(faster, small_example(emulator)) for faster in fitting}
    _LOG.info("Seconds of %d bundles: %s.", _BUNDLES, seconds)
    return min(fitting, key=lambda faster: seconds[faster.runtime.name])


def _checked(emulator: Emulator, runtime: str | Runtime) -> Emulator:
    """The emulator with a runtime whose results are torch's."""
    faster = emulator.with_runtime(runtime)
    if not isinstance(faster.runtime, Eager):
        _check_deviation(emulator.with_runtime("eager"), faster, small_example(emulator))
    return faster


def _seconds(emulator: Emulator, state: Particles) -> float:
    """The least time of a few rollouts, after one in which programs are compiled."""
    times = []
    for _ in range(1 + _ROUNDS):
        start = time.perf_counter()
        rollout(emulator, state, _BUNDLES * emulator.frames).cpu()  # waits for the device
        times.append(time.perf_counter() - start)
    return min(times[1:])


def _check_deviation(emulator: Emulator, faster: Emulator, state: Particles) -> None:
    """Compare one bundle without constraints, whose thresholds would amplify rounding.

    In bfloat16 a runtime may be twice as far from float32 as torch's bfloat16 is: each rounds in places of its own.
    """
    noise = torch.randn(state.velocity.shape, generator=torch.Generator().manual_seed(0)).to(state.velocity)
    cell = state.velocity.new_tensor(emulator.grid.spacing)
    moving = dataclasses.replace(state, velocity=state.velocity + _SPEED * cell * noise)
    forms = (emulator.with_network(torch.float32), emulator, faster)
    exact, *paths = (_positions(form, moving) for form in forms)
    reference, other = (float((path - exact).norm(dim=-1).max()) for path in paths)
    limit = TOLERANCE + 2 * reference
    name, precision = faster.runtime.name, str(emulator.network_precision).removeprefix("torch.")
    _LOG.info("The runtime %s, %s: within %.1e cells of torch in float32 after a bundle.", name, precision, other)
    if not other <= limit:
        raise ConfigError(
            f"The runtime {name} computes something else than torch: positions after one bundle differ by {other:.2g}"
            f" cells, where {limit:.2g} are expected in {precision}. Use the runtime eager."
        )


@torch.no_grad()
def _positions(emulator: Emulator, state: Particles) -> Tensor:
    """(B, m, N, D) after one bundle, in cells."""
    position: Tensor = emulator.unconstrained()(state).position
    return position / position.new_tensor(emulator.grid.spacing)
