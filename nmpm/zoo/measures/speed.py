"""Time and memory of a model's rollouts on this machine."""

from __future__ import annotations

import math
import statistics
from pathlib import Path
from typing import Any

from nmpm._support.machine import device_name
from nmpm._support.messages import one_line
from nmpm.emulator import rollout
from nmpm.errors import ZooError
from nmpm.evaluation.machine import peak_bytes, wall_clock
from nmpm.particles import Particles
from nmpm.zoo.card import read_card
from nmpm.zoo.optimization import fitting_count
from nmpm.zoo.pretrained import Pretrained

BATCHES = (1, 4, 16)
REPETITIONS = 5
PARTICLES = 1000


def speed_facts(model: Pretrained, folder: Path) -> dict[str, Any]:
    """The key `speed` of a card: what `measure_speed` returns, and what the card states of other hardware by then."""
    measured = measure_speed(model)
    others = [time for time in read_card(folder).get("speed") or [] if time["hardware"] != measured["hardware"]]
    return {"speed": [*others, measured]}


def measure_speed(model: Pretrained) -> dict[str, Any]:
    """Time rollouts of a thrown block of about as many particles as the test scenes have, as far as they fit.

    Returns:
        `hardware`, `runtime`, `particles`, `ms_per_frame` of one scene, the `best_batch` of `BATCHES` with its
        `best_ms_per_frame` per scene; `memory_mb` and `best_memory_mb`, the peaks of one scene and of that batch beside
        the weights, in MB, None where nothing counts them.
    """
    state = thrown_scene(model)
    times = {batch: _milliseconds(model, repeat_scene(state, batch)) / batch for batch in BATCHES}
    best = min(times, key=lambda batch: times[batch])
    memory = {batch: _peak_memory(model, repeat_scene(state, batch)) for batch in (1, best)}
    return {
        "hardware": device_name(model.emulator.device),
        "runtime": f"{model.emulator.runtime.name} {str(model.emulator.network_precision).removeprefix('torch.')}",
        "particles": state.position.shape[1],
        "ms_per_frame": round(times[1], 4),
        "best_batch": best,
        "best_ms_per_frame": round(times[best], 4),
        "memory_mb": memory[1],
        "best_memory_mb": memory[best],
    }


def thrown_scene(model: Pretrained) -> Particles:
    """A thrown block of about as many particles as the test scenes have, as far as they fit, on the model's device."""
    stated = model.card.get("particles", PARTICLES)
    if not isinstance(stated, int) or isinstance(stated, bool) or stated < 1:
        raise ZooError(f"{model.name}: particles of its card should be their number, not {one_line(repr(stated), 60)}.")
    return model.example(count=fitting_count(model.emulator, stated)).to(model.emulator.device)


def repeat_scene(state: Particles, batch: int) -> Particles:
    """One scene, batch times."""
    return state.map(lambda values: values.expand(batch, *values.shape[1:]).contiguous())


def _milliseconds(model: Pretrained, state: Particles) -> float:
    """Median milliseconds per frame, for all scenes of the batch together, over two bundles."""
    frames, times = 2 * model.emulator.frames, []
    for _ in range(REPETITIONS + 1):
        start = wall_clock()
        rollout(model.emulator, state, frames)
        times.append(1e3 * (wall_clock() - start) / frames)
    return statistics.median(times[1:])


def _peak_memory(model: Pretrained, state: Particles) -> float | None:
    """Peak of the MB that a rollout of two bundles allocates; None where nothing counts them."""
    peak = peak_bytes(lambda: rollout(model.emulator, state, 2 * model.emulator.frames), model.emulator.device)
    return round(peak / 1e6, 1) if math.isfinite(peak) else None
