"""Choices for a dataset by the rules of the shipped configurations (docs/recipes.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from nmpm.data.facts import FOUND, find_facts
from nmpm.data.format import Split
from nmpm.data.grid_rule import GridCost, GridFacts, Machine, TrainingSize, grid_cost, recommended_cells, training_size
from nmpm.data.inspection.irregular_motion import smoothing_frames
from nmpm.data.inspection.reading import open_dataset
from nmpm.data.loading.sources import FolderSource
from nmpm.data.metadata import FAMILIES
from nmpm.data.new_configuration.survey import Survey, survey
from nmpm.data.split_files import find_split, split_paths
from nmpm.errors import DataError
from nmpm.scene import Scene

OPTIONS = ("family", "gravity", "boundary", "bounds", "fields", "prescribed", "resample", "smooth", "files")
"""Facts that a configuration can state in its section data."""
FRAMES = 8
MOST_GAIN = 0.05
"""Energy, of the initial one, that may be gained by rounding and elasticity where nothing feeds the scene."""


@dataclass(frozen=True)
class CompletedSource:
    """A dataset, with what its metadata lack found in the trajectories."""

    data: FolderSource
    hows: dict[str, str]  # how options were found, by their names

    @classmethod
    def of(cls, source: FolderSource) -> CompletedSource:
        """The dataset with a guessed family of type ids, and measured gravity, where nobody states them.

        Raises:
            DataError: if it has no training trajectories, or cannot be read.
        """
        if not (folder := source.folder).is_dir() or "train" not in split_paths(folder):
            raise DataError(
                f"{source.path}: there is no train split (found: {', '.join(split_paths(folder)) or 'none'}). Put most"
                " trajectories into train.h5, some into valid.h5 and test.h5; a tenth each is enough."
            )
        hows = {}
        opened = open_dataset(source).source
        if opened.options.family != source.options.family:
            hows["family"] = f"guessed from the particles' type ids; or one of {', '.join(FAMILIES)}"
        scene = opened.scene
        if not scene.gravity_known and FOUND not in opened.metadata.extra:
            gravity = find_facts(Split(find_split(folder, "train")), opened.metadata).gravity
            if gravity.value is not None:
                opened = FolderSource(opened.path, replace(opened.options, gravity=gravity.value))
                hows["gravity"] = str(gravity)
        return cls(opened, hows)

    def look(self) -> tuple[CompletedSource, Survey]:
        """The dataset at even times, and smoothed where its positions are noisy, and facts about its trajectories."""
        facts, options, hows = survey(self.data), self.data.options, {}
        if facts.uneven and options.resample is None:
            options = replace(options, resample=float(f"{facts.uneven:.6g}"))
            hows["resample"] = "frames are at uneven times: positions are interpolated to even ones"
        if facts.noise and options.smooth is None:
            options = replace(options, smooth=smoothing_frames(facts.noise_share))
            noise = f"{facts.noise:.2g}, {facts.noise_share:.0%} of a typical step"
            hows["smooth"] = f"positions have a noise of {noise}: local fits replace them"
        if not hows:
            return self, facts
        changed = FolderSource(self.data.path, options)
        return CompletedSource(changed, self.hows | hows), survey(changed)


@dataclass(frozen=True)
class Choice:
    """The grid that is chosen for a dataset, and what a training on it costs."""

    scene: Scene
    survey: Survey
    machine: Machine
    grid: GridFacts
    size: TrainingSize
    cost: GridCost

    @classmethod
    def of(cls, scene: Scene, survey: Survey, machine: Machine) -> Choice:
        """The choice by the rule for the grid, with as many bundles as the shortest trajectory has frames for."""
        cells = recommended_cells(survey.grids, survey.particles, machine)
        grid = next(grid for grid in survey.grids if grid.cells == cells)
        size = training_size(grid.shape, survey.particles, machine)
        size = size.with_unroll(max(1, min(size.unroll, (survey.frames - 2) // FRAMES)))
        return cls(scene, survey, machine, grid, size, grid_cost(grid.shape, survey.particles, machine, size))

    @property
    def frames(self) -> int:
        """Frames predicted by a call."""
        return max(1, min(FRAMES, self.survey.frames - 2))

    @property
    def fed(self) -> str:
        """Why energy may come in, or ""."""
        scene, survey = self.scene, self.survey
        if not scene.gravity_known:
            return "gravity is not known"
        if scene.moving_obstacles:
            return "walls move"
        if "open" in scene.boundary or survey.comings:
            return "particles come and go"
        if survey.gain is None:
            return "gravity acts along a periodic axis"
        share = f", by {survey.gain:.0%} of the initial" if math.isfinite(survey.gain) else ""
        return f"energy rises in the data{share}" if survey.gain > MOST_GAIN else ""

    @property
    def transient(self) -> bool:
        """Whether scenes begin unlike they go on."""
        return not self.survey.settles and not (self.survey.stationary and self.fed)

    def cells_per_frame(self, length: float) -> float:
        """A length per frame in cells per frame."""
        return length * self.grid.cells / max(high - low for low, high in self.scene.domain)
