"""Settling: the shape of the material once it is at rest, beside the simulator's from the same initial states."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from torch import Tensor

from nmpm.emulator import Emulator
from nmpm.emulator.rollouts import stream
from nmpm.evaluation.shape import Shape, measure_shape
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject, simulate_beside
from nmpm.particles import Particles, Window
from nmpm.sim import Preset
from nmpm.sim.predictability import twin_of

MAX_DEVIATION = 0.05
"""Share by which height, occupied cells and crowding may differ from the simulator's."""

Shapes = dict[int, list[Shape]]
"""Shapes by frame, one for each window."""

_GROUP = "settling"
_NEEDS = f"height, occupied cells and crowding within {MAX_DEVIATION:.0%} of the simulator's"


def settling(subject: Subject, size: Size) -> Iterator[Line]:
    """Shape beside the simulator's at the same frames, with constraints and without.

    Constraints freeze particles that hardly move, so that a test of resting material alone would test them, not the
    network. Each figure is reported beside that of the simulator's twin, which shows the simulator's own scatter.
    """
    if subject.preset is None or not subject.emulator.scene.gravity_known:
        yield Line(_GROUP, "shape beside the simulator: there is none, or gravity is unknown", None, {})
        return
    forms = {"with constraints": subject.emulator, "without constraints": subject.emulator.unconstrained()}
    if forms["with constraints"].constraints == forms["without constraints"].constraints:
        del forms["with constraints"]
    frames = [round(multiple * subject.preset.frames) for multiple in size.settling_multiples]
    twin, *others = _compare(subject, subject.preset, list(forms.values()), frames, size.settling_scenes)
    for name, ratios in zip(forms, others, strict=True):
        yield _line(name, ratios, twin)


def compare_shapes(emulator: Emulator, window: Window, frames: Sequence[int]) -> dict[int, dict[str, float]]:
    """Measures of a rollout over those of the recorded trajectories, by frame (from 1) and name."""
    predicted = predicted_shapes(emulator, window.initial, frames)
    return _ratios(predicted, recorded_shapes(emulator, window, frames), frames)


def _compare(
    subject: Subject, preset: Preset, emulators: Sequence[Emulator], frames: Sequence[int], scenes: int
) -> list[dict[int, dict[str, float]]]:
    """Measures of the twin and of each emulator over the simulator's, scene by scene, as long ones take memory."""
    found: list[Shapes] = [{frame: [] for frame in frames} for _ in range(len(emulators) + 2)]
    for truth, twin in simulate_beside(subject, preset, scenes, max(frames), [twin_of(preset)]):
        shapes = [recorded_shapes(subject.emulator, window, frames) for window in (truth, twin)]
        shapes += [predicted_shapes(emulator, truth.initial, frames) for emulator in emulators]
        for kept, own in zip(found, shapes, strict=True):
            for frame in frames:
                kept[frame] += own[frame]
    simulated, *others = found
    return [_ratios(other, simulated, frames) for other in others]


def recorded_shapes(emulator: Emulator, window: Window, frames: Sequence[int]) -> Shapes:
    """The shapes of a window's trajectories at frames, which count from 1, on an emulator's grid."""
    return {frame: [_shape(emulator, window.initial, window.target[:, frame - 1])] for frame in frames}


def predicted_shapes(emulator: Emulator, state: Particles, frames: Sequence[int]) -> Shapes:
    """The shapes of a rollout at frames, which count from 1; only one bundle is kept at a time."""
    shapes, made = {}, 0
    for bundle in stream(emulator, state, max(frames)):
        for frame in frames:
            if made < frame <= made + bundle.shape[1]:
                shapes[frame] = [_shape(emulator, state, bundle[:, frame - made - 1])]
        made += bundle.shape[1]
    return shapes


def _shape(emulator: Emulator, state: Particles, position: Tensor) -> Shape:
    return measure_shape(emulator.scene, emulator.grid, state, position)


def _ratios(these: Shapes, those: Shapes, frames: Sequence[int]) -> dict[int, dict[str, float]]:
    return {frame: Shape.concatenate(these[frame]).relative_to(Shape.concatenate(those[frame])) for frame in frames}


def _line(name: str, ratios: Mapping[int, Mapping[str, float]], twin: Mapping[int, Mapping[str, float]]) -> Line:
    own = {f"{what}_at_{frame}": value for frame, row in ratios.items() for what, value in row.items()}
    other = {f"twin_{what}_at_{frame}": value for frame, row in twin.items() for what, value in row.items()}
    worst = max(abs(value - 1) for value in own.values())
    return Line(_GROUP, f"shape beside the simulator, {name}", worst <= MAX_DEVIATION, own | other, _NEEDS)
