"""Presets: everything that a simulated family of scenes is made of, read from one YAML file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import omegaconf
import yaml
from omegaconf import OmegaConf

from nmpm.errors import ConfigError
from nmpm.scene import Interval, Scene
from nmpm.sim.materials import MATERIALS, Material

CFL_LIMIT = 0.9
"""Cells that an elastic wave may cross in a substep; from 1 on, the explicit substep is unstable."""


@dataclass(frozen=True)
class Blocks:
    """How the initial state is drawn; lengths in metres.

    Args:
        number: Least and most blocks in a scene.
        particles: Least and most particles in a scene.
        share: Least part of the particles in one block.
        aspect: Least and largest height over width.
        gap: Least distance between blocks, and from the box's sides.
        speed: Largest initial velocity along each axis, in length per second.
        jitter: Largest displacement of a particle off the lattice along each axis, in spacings.

    Raises:
        ConfigError: if a range is empty or out of reach.
    """

    number: tuple[int, int]
    particles: tuple[int, int]
    share: float
    aspect: tuple[float, float]
    gap: float
    speed: float
    jitter: float

    def __post_init__(self) -> None:
        for key in ("number", "particles", "aspect"):
            low, high = getattr(self, key)
            _require(0 < low <= high, f"blocks.{key} = {[low, high]} needs two positive numbers, the lower first.")
        _require(0 < self.share * self.number[1] <= 1, f"blocks.share = {self.share} is too large for the blocks.")
        _require(0 <= self.jitter < 0.5, f"blocks.jitter = {self.jitter} must be at least 0 and below 0.5.")
        _require(self.gap >= 0 and self.speed >= 0, "blocks.gap and blocks.speed must not be negative.")


@dataclass(frozen=True)
class Preset:
    """A family of simulated scenes; `presets/goop.yaml` comments every entry.

    Args:
        name: Of the family.
        frames: Simulated frames of a trajectory after its initial state.
        frame_dt: Time between frames, in seconds.
        substeps: Substeps of a frame.
        box: Where particles may be, (lower, upper) along x and y, in length.
        domain: What an emulator's grid covers, likewise.
        cells: Grid cells along x, from side to side of the box.
        spacing: Distance between particles in the initial lattice, in length.
        gravity: Acceleration, in length per second squared.
        wall_friction: Coulomb friction at the walls.
        materials: What blocks are made of.
        blocks: How the initial state is drawn.

    Raises:
        ConfigError: if the numbers contradict each other or a substep is too long to be stable.
    """

    name: str
    frames: int
    frame_dt: float
    substeps: int
    box: tuple[Interval, Interval]
    domain: tuple[Interval, Interval]
    cells: int
    spacing: float
    gravity: tuple[float, float]
    wall_friction: float
    materials: tuple[Material, ...]
    blocks: Blocks

    def __post_init__(self) -> None:
        for key in ("frames", "substeps", "cells"):
            _require(isinstance(getattr(self, key), int), f"{key} = {getattr(self, key)} must be a whole number.")
        for key in ("frames", "frame_dt", "substeps", "cells", "spacing"):
            _require(0 < getattr(self, key) < math.inf, f"{key} = {getattr(self, key)} must be positive and finite.")
        _require(self.wall_friction >= 0, f"wall_friction = {self.wall_friction} must not be negative.")
        _require(bool(self.materials), f"materials is empty; known are {', '.join(MATERIALS)}.")
        (left, right), (bottom, top) = self.box
        _require(left < right and bottom < top, f"box = {self.box} needs (lower, upper) along each axis.")
        rows = (top - bottom) / self.cell_size
        _require(
            abs(rows - round(rows)) < 1e-6, f"cells = {self.cells} along x make {rows:.3f} rows, not a whole number."
        )
        least = self.least_substeps
        _require(
            self.substeps >= least,
            f"substeps = {self.substeps} are too few: at {self.wave_speed:.1f} m/s an elastic wave crosses more than "
            f"{CFL_LIMIT} cells in one. Take at least {least}, or a softer material.",
        )

    @property
    def cell_size(self) -> float:
        """Side of a grid cell, in length."""
        return (self.box[0][1] - self.box[0][0]) / self.cells

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Grid cells along x and y."""
        return self.cells, round((self.box[1][1] - self.box[1][0]) / self.cell_size)

    @property
    def particle_volume(self) -> float:
        """Area of one particle."""
        return self.spacing**2

    @property
    def wave_speed(self) -> float:
        """Of the fastest elastic wave, in length per second."""
        return max(material.wave_speed for material in self.materials)

    @property
    def least_substeps(self) -> int:
        """Fewest substeps of a frame that keep elastic waves within `CFL_LIMIT`."""
        return math.ceil(self.frame_dt * self.wave_speed / (CFL_LIMIT * self.cell_size))

    def coarsened(self, factor: int) -> Preset:
        """The same particles on a grid with cells `factor` times as large and substeps as long as stability allows.

        Raises:
            ConfigError: if the cells do not divide by the factor.
        """
        _require(self.cells % factor == 0, f"{self.cells} cells cannot be coarsened {factor} times.")
        longest = dataclasses.replace(self, cells=self.cells // factor, substeps=2**31)
        return dataclasses.replace(longest, substeps=longest.least_substeps)

    def to_dict(self) -> dict[str, Any]:
        """The preset as plain lists, strings and numbers, laid out as in its file."""
        plain = dataclasses.asdict(self)
        plain["materials"] = {material.name: material.to_dict() for material in self.materials}
        return {key: _listed(value) for key, value in plain.items()}


def load_preset(name_or_path: str | Path) -> Preset:
    """A preset by its shipped name, or from a YAML file.

    Raises:
        ConfigError: if there is no such preset, or it cannot be read.
    """
    shipped = resources.files("nmpm.sim") / "presets"
    path = shipped / f"{name_or_path}.yaml"
    if not path.is_file():
        path = Path(name_or_path)
    if not path.is_file():
        known = sorted(item.name.removesuffix(".yaml") for item in shipped.iterdir() if item.name.endswith(".yaml"))
        raise ConfigError(f"There is no preset or file {name_or_path}; shipped presets: {', '.join(known)}.")
    try:
        plain = OmegaConf.to_container(OmegaConf.create(path.read_text(encoding="utf-8")), resolve=True)
        return preset_from_dict(plain)
    except (yaml.YAMLError, omegaconf.errors.OmegaConfBaseException, UnicodeDecodeError, ConfigError) as error:
        raise ConfigError(f"Preset {name_or_path}: {error}") from error


def preset_from_dict(plain: Any) -> Preset:
    """The preset that `Preset.to_dict` described.

    Raises:
        ConfigError: if a key is unknown, missing or of the wrong kind.
    """
    entries = _checked(Preset, plain, "the preset")
    entries["blocks"] = _built(Blocks, entries["blocks"], "blocks")
    if not isinstance(entries["materials"], Mapping):
        raise ConfigError("materials must map names to parameters.")
    unknown = sorted(set(entries["materials"]) - set(MATERIALS))
    if unknown:
        raise ConfigError(f"Unknown material {', '.join(map(str, unknown))}; known are {', '.join(MATERIALS)}.")
    entries["materials"] = tuple(
        _built(MATERIALS[name], parameters, f"materials.{name}") for name, parameters in entries["materials"].items()
    )
    preset: Preset = _built(Preset, entries, "the preset")
    return preset


def scene_of(preset: Preset) -> Scene:
    """The facts that the preset's trajectories share, without simulating one."""
    return Scene(
        bounds=preset.box,
        domain=preset.domain,
        dt=preset.frame_dt,
        materials=tuple(material.name for material in preset.materials),
        particle_volume=preset.particle_volume,
        gravity=preset.gravity,
    )


def _checked(kind: type[Any], plain: Any, where: str) -> dict[str, Any]:
    if not isinstance(plain, Mapping):
        raise ConfigError(f"{where} must map keys to values; it is {plain!r}.")
    known = {field.name for field in dataclasses.fields(kind)}
    for problem, keys in (("unknown", set(plain) - known), ("missing", known - set(plain))):
        if keys:
            raise ConfigError(
                f"{where}: {problem} {', '.join(sorted(map(str, keys)))}; keys: {', '.join(sorted(known))}."
            )
    return dict(plain)


def _built(kind: type[Any], plain: Any, where: str) -> Any:
    entries = {key: _tupled(value) for key, value in _checked(kind, plain, where).items()}
    try:
        return kind(**entries)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from error


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(message)


def _listed(value: Any) -> Any:
    return [_listed(item) for item in value] if isinstance(value, tuple | list) else value


def _tupled(value: Any) -> Any:
    return tuple(_tupled(item) for item in value) if isinstance(value, tuple | list) else value
