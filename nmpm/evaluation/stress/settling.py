"""Settling: from ordinary starts to well past rest, does the material stand as high as in the simulator?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from torch import Tensor

from nmpm.emulator import Emulator, rollout
from nmpm.evaluation.shape import measure_shape
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject, simulate_window
from nmpm.particles import Particles, Window

MAX_DEVIATION = 0.05
"""Share by which height, occupied cells and crowding may differ from the simulator's."""

_GROUP = "settling"
_NEEDS = f"height, occupied cells and crowding within {MAX_DEVIATION:.0%} of the simulator's"


def settling(subject: Subject, size: Size) -> Iterator[Line]:
    """Shape beside the simulator's at the same frames, with constraints and without.

    Constraints freeze what they take for resting, so that measuring only what rests would test them, not the network.
    """
    if subject.preset is None or not subject.emulator.scene.gravity_known:
        yield Line(_GROUP, "shape beside the simulator: there is none, or gravity is unknown", None, {})
        return
    frames = [round(multiple * subject.preset.frames) for multiple in size.settling_multiples]
    window = simulate_window(subject, subject.preset, size.scenes, frames[-1])
    forms = {"with constraints": subject.emulator, "without constraints": subject.emulator.unconstrained()}
    for name, emulator in forms.items():
        yield _line(name, compare_shapes(emulator, window, frames))


def compare_shapes(emulator: Emulator, window: Window, frames: list[int]) -> dict[int, dict[str, float]]:
    """Measures of a rollout over those of the recorded trajectories, by frame (from 1) and name."""
    predicted = rollout(emulator, window.initial, frames[-1])
    return {frame: _ratios(emulator, window.initial, predicted, window.target, frame) for frame in frames}


def _ratios(emulator: Emulator, state: Particles, predicted: Tensor, target: Tensor, frame: int) -> dict[str, float]:
    shapes = [
        measure_shape(emulator.scene, emulator.grid, state, positions[:, frame - 1])
        for positions in (predicted, target)
    ]
    return shapes[0].relative_to(shapes[1])


def _line(name: str, ratios: Mapping[int, Mapping[str, float]]) -> Line:
    figures = {f"{what}_at_{frame}": value for frame, row in ratios.items() for what, value in row.items()}
    worst = max(abs(value - 1) for value in figures.values())
    return Line(_GROUP, f"shape beside the simulator, {name}", worst <= MAX_DEVIATION, figures, _NEEDS)
