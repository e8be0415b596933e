"""What the battery prints: lines that pass or fail by a stated invariant, and figures that are only reported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Line:
    """One test of the battery.

    Args:
        group: What kind of extreme it is.
        name: Which one.
        passed: Whether the invariant holds; None for figures that are reported without a verdict.
        figures: What was measured, by name; names end with their unit where there is one.
        needs: The invariant in words; empty for mere reports.
        curves: What may be drawn, by name: values evenly spaced over the rollout, and its number of frames.
    """

    group: str
    name: str
    passed: bool | None
    figures: Mapping[str, float]
    needs: str = ""
    curves: Mapping[str, tuple[Sequence[float], int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Size:
    """How much of everything the battery does.

    Args:
        scenes: Scenes of each kind.
        horizons: Length of the long rollouts, in training horizons.
        far: Frames of the longest rollout.
        settling: Length of the simulation after which material counts as settled, in trajectories of the preset.
        settled: Frames over which settled material must keep its volume.
        compared: Frames that are compared with the simulator.
        particles: Most particles in one scene.
        bundles: Most bundles that gradients go through.
    """

    scenes: int
    horizons: int
    far: int
    settling: int
    settled: int
    compared: int
    particles: int
    bundles: int


QUICK = Size(scenes=2, horizons=25, far=4_000, settling=3, settled=1_600, compared=160, particles=100_000, bundles=16)
FULL = Size(
    scenes=8, horizons=100, far=100_000, settling=5, settled=12_000, compared=400, particles=10_000_000, bundles=64
)
