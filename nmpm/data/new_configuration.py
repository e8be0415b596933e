"""New configurations for datasets, chosen by what up to eight training trajectories show."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined

from nmpm._support.messages import span
from nmpm._support.progress import progress_bar
from nmpm.data.facts import find_facts
from nmpm.data.families import FAMILIES
from nmpm.data.format import Split, find_split, split_paths
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.grid_rule import GridCost, GridFacts, Machine, TrainingSize, grid_cost, recommended_cells, training_size
from nmpm.data.inspection import open_dataset
from nmpm.data.metadata import FOUND
from nmpm.data.sources import FolderSource
from nmpm.data.survey import RecordedMotion, Survey, smoothing_frames
from nmpm.errors import DataError
from nmpm.scene import Scene

OPTIONS = ("family", "gravity", "boundary", "bounds", "fields", "prescribed", "resample", "smooth", "files")
"""Facts that a configuration can state in its section data."""
TRAJECTORIES = 8
FRAMES = 8
MOST_GAIN = 0.05
"""Energy, of the initial one, that may be gained by rounding and elasticity where nothing feeds the scene."""
FEW = 100
"""Training trajectories below which mirror images are worth their doubled variety."""
LONG = 40.0
"""Minutes from which the learning rate is halved: trainings of hours may diverge at 6e-3."""
LARGE = 4000
"""Particles from which evaluations and buffers hold fewer trajectories."""
_CROWDED = 1.8  # volume fraction of late cells from which a density cap is worth it
_OFF_CENTRE = 0.25  # cells by which walls may lie off their mirror image
_BUFFER_BYTES = 1e9
_WIDTH = 118

_TRIVIAL = {"particle_types", "sequence_length"}  # of which the title and the data say as much

Entry = tuple[str, str]
"""A value as YAML, and a comment."""


@dataclass(frozen=True)
class CompletedSource:
    """A dataset, with what its metadata lack found in the trajectories."""

    data: FolderSource
    hows: Mapping[str, str]  # how options were found, by their names
    survey: Survey

    @classmethod
    def of(cls, source: FolderSource) -> CompletedSource:
        """The dataset with a guessed family of type ids and measured gravity, where nobody states them.

        It is at even times, and smoothed where its positions are noisy.

        Raises:
            DataError: if it has no training trajectories, or cannot be read.
        """
        if not (folder := source.folder).is_dir() or "train" not in split_paths(folder):
            raise DataError(
                f"{source.path}: there is no train split (found: {', '.join(split_paths(folder)) or 'none'}). Put most"
                " trajectories into train.h5, some into valid.h5 and test.h5; a tenth each is enough."
            )
        hows, opened = dict[str, str](), open_dataset(source)
        path, options = opened.source.path, opened.source.options
        if options.family != source.options.family:
            hows["family"] = f"guessed from the particles' type ids; or one of {', '.join(FAMILIES)}"
        if not opened.source.scene.gravity_known and FOUND not in opened.metadata.extra:
            gravity = find_facts(Split(find_split(folder, "train")), opened.metadata).gravity
            if gravity.value is not None:
                options, hows["gravity"] = replace(options, gravity=gravity.value), str(gravity)
        survey = look_at(data := FolderSource(path, options))
        if survey.uneven and options.resample is None:
            options = replace(options, resample=float(f"{survey.uneven:.6g}"))
            hows["resample"] = "frames are at uneven times: positions are interpolated to even ones"
        noise, share = survey.noise
        if noise and options.smooth is None:
            options = replace(options, smooth=smoothing_frames(share))
            hows["smooth"] = (
                f"positions have a noise of {noise:.2g}, {share:.0%} of a typical step: local fits replace them"
            )
        if options != data.options:
            survey = look_at(data := FolderSource(path, options))
        return cls(data, hows, survey)


def look_at(source: FolderSource) -> Survey:
    """A survey of training trajectories, with a progress bar; raises a DataError if they cannot be read."""
    metadata, scene = source.metadata, source.scene
    splits = {name: Split(path) for name, path in split_paths(source.folder).items()}
    split, survey = splits["train"], Survey(splits, metadata, scene)
    sample = split.spread(TRAJECTORIES)
    with progress_bar("Looking at the data", len(sample)) as advance:
        for index in sample:
            motion = RecordedMotion(split.read(index), metadata, split.where(index))
            gravity = trajectory_gravity(motion.trajectory.attributes, scene, motion.where)
            survey.add(motion)
            survey.add_dynamics(motion, split.time(index), replace(scene, gravity=gravity))
            advance()
    return survey


@dataclass(frozen=True)
class SettingsChoice:
    """The grid that is chosen for a dataset, and what a training on it costs."""

    source: CompletedSource
    machine: Machine
    grid: GridFacts
    size: TrainingSize
    frames: int  # predicted by a call
    cost: GridCost

    @classmethod
    def of(cls, source: CompletedSource, machine: Machine) -> SettingsChoice:
        """The choice by the rule for the grid, with as many bundles as the shortest trajectory has frames for."""
        survey, grids = source.survey, source.survey.grids()
        cells = recommended_cells(grids, survey.present, machine)
        grid = next(grid for grid in grids if grid.cells == cells)
        size = training_size(grid.shape, survey.present, machine)
        size = replace(size, unroll=max(1, min(size.unroll, (survey.shortest - 2) // FRAMES)))
        frames = max(1, min(FRAMES, survey.shortest - 2))
        return cls(source, machine, grid, size, frames, grid_cost(grid.shape, survey.present, machine, size))

    @property
    def scene(self) -> Scene:
        """The scene of the dataset."""
        return self.source.data.scene

    @property
    def survey(self) -> Survey:
        """What the dataset's trajectories show."""
        return self.source.survey

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

    def configuration(self, path: str, root: str) -> str:
        """The YAML of a configuration.

        Args:
            path: The dataset, as the user names it.
            root: Folder of the run's files.
        """
        scene, grid, seconds, minutes = self.scene, self.grid, self.cost.seconds, self.machine.minutes
        counts = ", ".join(f"{len(sizes)} {name}" for name, sizes in self.survey.sizes.items())
        materials = "" if scene.materials == ("particles",) else f" of {', '.join(scene.materials)}"
        longest = max(high - low for low, high in scene.domain)
        square = tuple(round(grid.cells * (high - low) / longest) for low, high in scene.domain)
        memory = f"; {self.cost.memory / 1e9:.2g} GB of memory" if scene.dim == 3 else ""
        how = f"{grid.per_cell:.2g} particles per occupied cell, up to {grid.high_speed:.2g} cells a frame{memory}"
        stated = {name: getattr(self.source.data.options, name) for name in OPTIONS}
        loader = PackageLoader("nmpm.data")
        environment = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, autoescape=False)  # noqa: S701
        return environment.get_template("configuration.yaml").render(
            title=_wrapped(
                f"{path}: trajectories in {scene.dim}-D, {counts}, of up to {self.survey.present} particles{materials}."
                f" Written by nmpm init for a training of {minutes:.3g} minutes. Each key is explained in tutorial.yaml"
                " (nmpm --help)."
            ),
            root=_scalar(root),
            steps=_two_digits(1.25 * 0.9 * 60 * minutes / seconds),
            pace=f"{seconds:.2g} s a step here; a quarter more than the time holds, which ends it",
            time=_duration(minutes),
            validated="valid" in self.survey.sizes,
            interval=_duration(minutes / 5),
            cells=(str(grid.cells) if grid.shape == square else str(list(grid.shape)), how),
            frames=self.frames,
            unroll=self.size.unroll,
            width=self.size.width,
            constraints=self._constraints(),
            energy=f"energy: not limited, as {self.fed}" if self.fed else "energy does not rise in the data",
            rate="3.0e-3" if minutes >= LONG else "6.0e-3",
            augmentation=dict(self._augmentation()),
            path=_scalar(path),
            facts={
                name: (json.dumps(value, default=sorted), self.source.hows.get(name, "as given"))
                for name, value in stated.items()
                if value is not None
            },
            remarks=[line for remark in self._remarks() for line in _wrapped(remark)],
            batch_size=self.size.batch_size,
            sampling=dict(self._sampling()),
        )

    def _constraints(self) -> str:
        if self.fed:
            return "{energy: false, rest_speed: 0.0}"
        speed = 0.01 if self.survey.settles else self.cells_per_frame(self.survey.pace[2]) / 4
        cap, crowding = "", self.survey.crowding(self.scene, self.grid.shape)
        if crowding > _CROWDED and not self.survey.settles:
            cap = f", density_cap: {1.1 * crowding:.1f}"
        return f"{{energy: true, rest_speed: {min(max(speed, 0.0025), 0.01):.2g}{cap}}}"

    def _augmentation(self) -> Iterator[tuple[str, Entry]]:
        scene = self.scene
        axes = [axis for axis in range(scene.dim) if self._mirrors(axis)]
        if axes and len(self.survey.sizes["train"]) < FEW:
            yield "mirror", (str(axes), "few trajectories: mirror images double them")
        if self.transient and scene.bounds != scene.domain:
            yield "jitter", ("0.35", "cells by which the grid is moved at most: where cells lie should matter little")

    def _mirrors(self, axis: int) -> bool:
        scene = self.scene
        (low, high), (outer_low, outer_high) = scene.bounds[axis], scene.domain[axis]
        off_centre = abs(self.cells_per_frame(low + high - outer_low - outer_high))
        falls = scene.gravity is None or (scene.gravity[axis] != 0 and not scene.gravity_varies)
        return not falls and not self.fed and off_centre < _OFF_CENTRE

    def _remarks(self) -> Iterator[str]:
        """Facts and how they were found, then advice."""
        scene, metadata = self.scene, self.source.data.metadata
        gravity = "not known" if scene.gravity is None else ", ".join(f"{g:.6g}" for g in scene.gravity)
        gravity = "of each trajectory's own" if scene.gravity_varies else gravity
        bounds = f"{' x '.join(map(span, scene.bounds))}, {', '.join(scene.boundary)}"
        yield f"dt {metadata.dt:g}; gravity {gravity}; bounds {bounds}"
        found = metadata.extra.get(FOUND)
        for name, how in found.items() if isinstance(found, dict) else ():
            if name not in _TRIVIAL and (not name.endswith("_types") or getattr(metadata, name, None)):
                yield f"{name}: {how}"
        if not scene.gravity_known:
            yield "Without a known gravity none is added to what the network predicts; a key gravity here states it."

    def _sampling(self) -> Iterator[tuple[str, Entry]]:
        survey = self.survey
        held = int(_BUFFER_BYTES / (12 * self.scene.dim * survey.present * survey.shortest))
        if held < 16:
            yield "buffer_size", (str(max(held, 2)), "trajectories in memory")
        if len(survey.sizes["train"]) > min(held, 16):
            yield "passes", ("0.1" if survey.present > LARGE else "0.2", "a short training should see all trajectories")
        if survey.settles:
            yield "emphasis", ("0.7", "the scenes come to rest; windows of rest teach little")
        elif self.transient:
            yield "openings", ("0.3", "of the windows start where rollouts do: early errors decide the rest")
        if survey.present > LARGE:
            yield "eval_batch_size", ("2", "trajectories rolled out together")


def _scalar(text: str) -> str:
    return yaml.safe_dump(text, width=math.inf, allow_unicode=True).splitlines()[0]


def _two_digits(number: float) -> int:
    unit: int = 10 ** max(0, math.floor(math.log10(max(number, 1))) - 1)
    return math.ceil(number / unit) * unit


def _duration(minutes: float) -> str:
    seconds = math.ceil(60 * minutes)
    return f"{seconds // 86400:02d}:{seconds // 3600 % 24:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(" ".join(text.split()), _WIDTH - 4, subsequent_indent="  ")
