"""Lines of the battery's report: tests that pass or fail by a stated invariant, and figures without a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Line:
    """One test of the battery.

    Args:
        group: Kind of extreme.
        name: Name within the group.
        passed: Whether the invariant holds; None for figures that are reported without a verdict.
        figures: What was measured, by name; names end with their unit where there is one.
        needs: The invariant in words; empty where there is no verdict.
        curves: Curves to draw, by name: values evenly spaced over the rollout, and its number of frames.
    """

    group: str
    name: str
    passed: bool | None
    figures: Mapping[str, float]
    needs: str = ""
    curves: Mapping[str, tuple[Sequence[float], int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Size:
    """Amount of work of each kind that the battery does.

    Args:
        scenes: Scenes of each kind.
        horizons: Length of the long rollouts, in training horizons.
        far: Frames of the longest rollout.
        settling: Length of the simulation after which material counts as settled, in trajectories of the preset.
        settled: Frames over which settled material must keep its volume.
        compared: Frames that are compared with the simulator.
        particles: Largest number of particles in one scene.
        bundles: Largest number of bundles that gradients go through.
        settling_scenes: Scenes of the settling rollouts: single ones scatter by a fifth.
        settling_multiples: Where their shapes are compared, in trajectories of the preset.
    """

    scenes: int
    horizons: int
    far: int
    settling: int
    settled: int
    compared: int
    particles: int
    bundles: int
    settling_scenes: int = 8
    settling_multiples: tuple[float, ...] = (1.0, 5 / 3, 5 / 2)


QUICK = Size(scenes=2, horizons=25, far=4_000, settling=3, settled=1_600, compared=160, particles=100_000, bundles=16)
FULL = Size(
    scenes=8,
    horizons=100,
    far=100_000,
    settling=5,
    settled=12_000,
    compared=400,
    particles=10_000_000,
    bundles=64,
    settling_multiples=(1.0, 5 / 3, 5 / 2, 20.0),
)
