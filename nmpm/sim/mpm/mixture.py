"""A mixture of presets: each trajectory is drawn from one of them, as it is or with cells, times, walls … of its own.

All trajectories have one domain and one time between frames, whatever they were simulated with. A trajectory that is
simulated at s times the time between frames is recorded as one at the usual time: its velocities are s times, its
gravity s² times as large, which its attribute `gravity` states. The volume of its particles is the attribute
`particle_volume`. Walls within the box are recorded as particles that do not move.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from nmpm.errors import ConfigError, DataError
from nmpm.scene import Interval, Scene
from nmpm.sim.blocks import Layout
from nmpm.sim.mpm.layouts import SimulatedRamp
from nmpm.sim.mpm.preset import MpmPreset
from nmpm.sim.mpm.variation import MULTIPLE, FittedBox, Variation, area, fit_box, wall_bars
from nmpm.sim.preset import BOUNDARY, Preset
from nmpm.sim.state import Array, InitialState, Progress, SimulatedTrajectory, check, check_numbers

_ATTEMPTS = 20


@dataclass(frozen=True)
class Part:
    """A preset, and its share of the trajectories."""

    share: float
    preset: MpmPreset

    def __post_init__(self) -> None:
        check_numbers(self, "parts.", positive=("share",))
        is_flat = isinstance(self.preset, MpmPreset) and self.preset.dim == 2
        check(is_flat, "parts.preset must be a preset of the material point method in two dimensions, or its name.")


@dataclass(frozen=True)
class MixtureState(InitialState):
    """A state of a mixture, its velocity and gravity as they are recorded.

    Args:
        variant: What simulates it.
        time: Its time between frames, as a multiple of the mixture's.
        substeps: Of the mixture that drew it; one with fewer simulates it with as many fewer, where they are stable.
        static: (M, D) the particles that do not move.
    """

    variant: MpmPreset = dataclasses.field(kw_only=True)
    time: float = dataclasses.field(kw_only=True)
    substeps: int = dataclasses.field(kw_only=True)
    static: Array = dataclasses.field(kw_only=True)


@dataclass(frozen=True, kw_only=True)
class MpmMixture(Preset):
    """Presets of the material point method in two dimensions, mixed and varied; `presets/universal.yaml` comments it.

    `box` is how far particles get, `spacing` that of the particles obstacles are made of, and `substeps` are those of
    a frame at the usual time on cells as large; each trajectory takes at least as many as are stable. Further:

    Args:
        parts: The presets; where they are and how long their frames are is the mixture's.
        variation: How their scenes are varied.
        coarser: Size of the simulator's cells, as a multiple of those that the scenes are drawn for.

    Raises:
        ConfigError: if the numbers contradict each other.
    """

    solver: ClassVar[str] = "mls_mpm_mixture"
    generator: ClassVar[str] = MpmPreset.generator
    revision: ClassVar[int] = MpmPreset.revision

    parts: tuple[Part, ...]
    variation: Variation
    coarser: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check(len(self.box) == len(self.domain) == len(self.gravity) == 2, "A mixture has two axes.")
        check(bool(self.parts), "parts is empty.")
        check(self.coarser in (1, 2, 4), f"coarser = {self.coarser} must be 1, 2 or 4.")

    def draw(self, seed: int) -> MixtureState:
        rng = np.random.default_rng(seed)
        for _ in range(_ATTEMPTS):
            variant, time = self._draw_variant(rng)
            try:
                start = variant.draw(int(rng.integers(2**62)))
            except ConfigError as error:  # no room for these blocks; others may fit
                reason = error
                continue
            return self._recorded(start, variant, time)
        raise reason

    def _draw_variant(self, rng: np.random.Generator) -> tuple[MpmPreset, float]:
        """The preset of a trajectory, and its time between frames as a multiple of the mixture's."""
        shares, varied = np.array([part.share for part in self.parts]), self.variation
        part = self.parts[int(rng.choice(len(shares), p=shares / shares.sum()))].preset
        if rng.random() >= varied.share:
            return self._variant(part, 1.0, fit_box(part, part.spacing, self._sides(part))), 1.0
        moved = varied.inset * rng.random((2, 2)) * (rng.random((2, 2)) < varied.narrowed)
        sides = [(low + a, high - b) for (low, high), (a, b) in zip(self.box, moved.tolist(), strict=True)]
        time, spacing = (math.exp(rng.uniform(*np.log(each))) for each in (varied.time, varied.spacing))
        box = fit_box(part, spacing, sides)
        changes: dict[str, Any] = {
            "gravity": varied.draw_gravity(part.gravity, rng),
            "gravity_turn": 0.0,
            "blocks": varied.draw_blocks(part, box, rng),
            "ramps": varied.draw_ramps(box.cell, rng),
        }
        return self._variant(part, time, box, **changes), time

    def _sides(self, part: MpmPreset) -> list[Interval]:
        """How far particles of a part that is not varied get: up to its own wall layer in the domain, within `box`."""
        layer = part.reach[0][0] - part.domain[0][0]
        pairs = zip(self.domain, self.box, strict=True)
        return [(max(outer[0] + layer, low), min(outer[1] - layer, high)) for outer, (low, high) in pairs]

    def _variant(self, part: MpmPreset, time: float, box: FittedBox, **changes: Any) -> MpmPreset:
        least = math.ceil(self.substeps * time * self.spacing / box.cell - 1e-9)
        facts = {"frame_dt": time * self.frame_dt, "domain": self.domain, "cells": box.cells}
        return part._with_stable_substeps(least, spacing=box.spacing, box=box.sides, **facts, **changes)

    def _recorded(self, start: InitialState, variant: MpmPreset, time: float) -> MixtureState:
        """A variant's state with velocity and gravity as they are recorded."""
        bars = (*start.obstacles_of(SimulatedRamp), *wall_bars(self.box, variant.reach))
        return MixtureState(
            start.position,
            time * start.velocity,
            tuple(time**2 * pull for pull in start.gravity or variant.gravity),
            start.counts,
            start.obstacles,
            variant=variant,
            time=time,
            substeps=self.substeps,
            static=np.concatenate([np.empty((0, 2)), *(bar.particles(self.spacing) for bar in bars)]),
        )

    def simulate_from(self, start: InitialState, frames: int, progress: Progress | None = None) -> SimulatedTrajectory:
        if not isinstance(start, MixtureState):
            raise DataError(f"The preset {self.name} simulates only states that it has drawn: each has its own solver.")
        variant, time = start.variant, start.time
        if self.substeps != start.substeps:
            variant = variant._with_stable_substeps(math.ceil(variant.substeps * self.substeps / start.substeps))
        if self.coarser > 1:
            variant = variant.coarsened(self.coarser)
        gravity = tuple(pull / time**2 for pull in start.gravity or self.gravity)
        state = InitialState(start.position, start.velocity / time, gravity, start.counts, start.obstacles)
        made = variant.simulate_from(state, frames, progress)
        moving = made.particle_type != BOUNDARY
        still = np.broadcast_to(start.static.astype(np.float32), (frames + 1, *start.static.shape))
        types = np.concatenate([made.particle_type[moving], np.full(len(start.static), BOUNDARY)])
        facts = {"gravity": np.array(start.gravity), "particle_volume": variant.spacing**2}
        position = np.concatenate([made.position[:, moving], still], axis=1)
        return SimulatedTrajectory(position, types, made.attributes | facts)

    @property
    def scene(self) -> Scene:
        materials = self._materials
        densities = tuple(materials[name] for name in self.type_names.values() if name in materials)
        return dataclasses.replace(super().scene, gravity=None, gravity_varies=True, densities=densities)

    @property
    def _materials(self) -> dict[str, float]:
        """Density of each material by name."""
        return {kind.name: kind.density for part in self.parts for kind in part.preset.materials}

    @property
    def type_names(self) -> dict[int, str]:
        kinds = {kind.particle_type: kind.name for part in self.parts for kind in part.preset.materials}
        return dict(sorted(kinds.items())) | {BOUNDARY: "boundary"}

    @property
    def max_particles(self) -> int:
        moving = max(self.variation.particles, *(part.preset.blocks.particles[1] for part in self.parts))
        return moving + math.ceil(1.5 * area(self.domain) / self.spacing**2)

    @property
    def stable_substeps(self) -> int:
        """1: each trajectory takes as many as are stable anyway."""
        return 1

    @property
    def _layouts(self) -> Mapping[str, Layout]:
        return {}

    def varied(self, *, speed: float = 1.0, gravity: float = 1.0) -> Self:
        return self._with_parts(lambda preset: preset.varied(speed=speed, gravity=gravity))

    def widened(self, times: int) -> Self:
        box, domain, _ = self._widened_sides(times, self.spacing)
        variation = dataclasses.replace(self.variation, particles=times * self.variation.particles)
        return self._with_parts(lambda preset: preset.widened(times), box=box, domain=domain, variation=variation)

    def coarsened(self, factor: int) -> Self:
        check(MULTIPLE % factor == 0, f"The cells of {self.name} cannot be coarsened {factor} times.")
        return dataclasses.replace(self, coarser=factor * self.coarser)

    def _with_parts(self, change: Callable[[MpmPreset], MpmPreset], **changes: Any) -> Self:
        parts = tuple(Part(part.share, change(part.preset)) for part in self.parts)
        return dataclasses.replace(self, parts=parts, **changes)

    def to_dict(self) -> dict[str, Any]:
        parts = [{"share": part.share, "preset": part.preset.to_dict()} for part in self.parts]
        return super().to_dict() | {"parts": parts}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        if "parts" not in plain:
            return super().from_dict(plain)
        section = plain["parts"]
        check(isinstance(section, list | tuple), "parts must list a share and a preset each.")
        return super().from_dict({**plain, "parts": [_with_preset(entry) for entry in section]})


def _with_preset(entry: Any) -> Any:
    """An entry of `parts` with its preset read, if it is described."""
    described = entry.get("preset") if isinstance(entry, Mapping) else None
    if not isinstance(described, Mapping):
        return entry
    facts = {key: value for key, value in described.items() if key != "solver"}
    return {**entry, "preset": MpmPreset.from_dict(facts)}
