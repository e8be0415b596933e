"""Faster runtimes and engines for trained models, compared with torch's own results before they are used."""

from __future__ import annotations

import dataclasses
import logging
import time

import torch
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm.backends import AUTO, ENGINES, RUNTIMES, check_runtime
from nmpm.emulator import Emulator
from nmpm.emulator.engines.explanation import missing_features
from nmpm.emulator.rollouts import rollout
from nmpm.emulator.runtimes import Eager, Runtime
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.zoo.states import thrown_state

TOLERANCE = 1e-3
"""Cells by which positions after one bundle may differ from torch's in float32."""
_EXAMPLE = 300  # particles of the example by which runtimes are compared
_SPEED = 0.2  # cells per frame, of the particles of the example: at rest, the network would have little to say
_SHARE = 0.1  # of particles that may differ by more with constraints, whose thresholds amplify rounding
_BUNDLES, _ROUNDS = 4, 3  # of the rollouts that are timed
_LONG = 2.0  # seconds of timed rollouts after which no further one is
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


def optimize(emulator: Emulator, runtime: str | Runtime, state: Particles | None = None) -> Emulator:
    """The emulator with another runtime, compared with torch on an example.

    Args:
        emulator: In evaluation mode.
        runtime: One of `RUNTIMES`, or its name, or that of one of `ENGINES`, or "auto".
        state: By which "auto" measures times, those of runtimes that pay in some scenes only among them; if left out,
            an example.

    Raises:
        ConfigError: if there is no such runtime, it cannot run the model here, or its results differ from torch's;
            "auto" leaves such a runtime out.
    """
    if isinstance(runtime, str):
        check_runtime(runtime)
        if runtime in ENGINES:
            return _with_engine(emulator, runtime)
    if runtime != AUTO:
        return _checked(emulator, runtime)
    fitting = []
    for name in RUNTIMES:
        try:
            if RUNTIMES[name].automatic or state is not None:
                fitting.append(_checked(emulator, name))
        except ConfigError as error:
            _LOG.info("%s", error)
    if len(fitting) == 1:
        return fitting[0]
    timed = small_example(emulator) if state is None else state.to(emulator.device)
    seconds = {faster.runtime.name: _seconds(faster, timed) for faster in fitting}
    _LOG.info("Seconds of %d bundles: %s.", _BUNDLES, seconds)
    return min(fitting, key=lambda faster: seconds[faster.runtime.name])


def _checked(emulator: Emulator, runtime: str | Runtime) -> Emulator:
    """The emulator with a runtime whose results are torch's."""
    faster = emulator.with_runtime(runtime)
    if not isinstance(faster.runtime, Eager):
        _check_deviation(
            f"runtime {faster.runtime.name}", emulator.with_runtime("eager"), faster, small_example(emulator)
        )
    return faster


def _with_engine(emulator: Emulator, name: str) -> Emulator:
    """The emulator with an engine that takes its rollouts here, and whose results are torch's."""
    other, reference = emulator.with_engine(name), emulator.with_engine("torch")
    if missing := min((missing_features(emulator, form, False) for form in ENGINES[name]), key=len, default=[]):
        raise ConfigError(f"The engine {name} does not take {', '.join(missing)}: use the runtime eager.")
    try:
        state = _check_deviation(f"engine {name}", reference, other, small_example(emulator))
        paths = [_positions(form, state) for form in (reference, other)]
    except ConfigError:
        raise
    except Exception as failure:  # (of whatever compilers and drivers raise)
        reason = f"{type(failure).__name__}: {one_line(failure, 200)}"
        raise ConfigError(f"The engine {name} fails here ({reason}): use the runtime eager.") from failure
    apart = ~((paths[0] - paths[1]).norm(dim=-1).amax(1) <= TOLERANCE)
    if (share := float(apart[state.mask].float().mean())) > _SHARE:
        raise ConfigError(
            f"The engine {name} computes something else than torch: with constraints {share:.0%} of the particles"
            f" differ by more than {TOLERANCE} cells after one bundle. Use the runtime eager."
        )
    return other


def _seconds(emulator: Emulator, state: Particles) -> float:
    """The least time of a few rollouts, after one in which programs are compiled; of one, where it takes long."""
    times = list[float]()
    while len(times) <= _ROUNDS and not sum(times[1:]) > _LONG:
        start = time.perf_counter()
        rollout(emulator, state, _BUNDLES * emulator.frames).cpu()  # waits for the device
        times.append(time.perf_counter() - start)
    return min(times[1:])


def _check_deviation(name: str, emulator: Emulator, faster: Emulator, state: Particles) -> Particles:
    """Compare one bundle of a state, moved at random, without constraints, whose thresholds would amplify rounding.

    In bfloat16 a runtime may be twice as far from float32 as torch's bfloat16 is: each rounds in places of its own.
    """
    noise = torch.randn(state.velocity.shape, generator=torch.Generator().manual_seed(0)).to(state.velocity)
    cell = state.velocity.new_tensor(emulator.grid.spacing)
    moving = dataclasses.replace(state, velocity=state.velocity + _SPEED * cell * noise)
    forms = (emulator.with_network(torch.float32), emulator, faster)
    exact, *paths = (_positions(form.unconstrained(), moving) for form in forms)
    reference, other = (float((path - exact).norm(dim=-1).max()) for path in paths)
    limit = TOLERANCE + 2 * reference
    precision = str(emulator.network_precision).removeprefix("torch.")
    _LOG.info("The %s, %s: within %.1e cells of torch in float32 after a bundle.", name, precision, other)
    if not other <= limit:
        raise ConfigError(
            f"The {name} computes something else than torch: positions after one bundle differ by {other:.2g}"
            f" cells, where {limit:.2g} are expected in {precision}. Use the runtime eager."
        )
    return moving


@torch.no_grad()
def _positions(emulator: Emulator, state: Particles) -> Tensor:
    """(B, m, N, D) after one bundle, in cells."""
    position: Tensor = emulator(state).position
    return position / position.new_tensor(emulator.grid.spacing)
