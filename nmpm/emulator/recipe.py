"""The recipe of an emulator: all that its form depends on, as plain data that checkpoints and zoo entries store."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from nmpm._support.plain_data import from_plain, from_spec, to_plain, to_spec, to_tuples
from nmpm.decoders import Decoder, Residual
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.model import Emulator
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors import Processor, Turned, UNet
from nmpm.scene import Scene, Turn
from nmpm.transfer import Linear, Transfer

FORMAT = 1
"""Version of the form that `to_dict` writes; raised when an older nmpm could not read it."""


@dataclass(frozen=True)
class EmulatorRecipe:
    """Everything that decides the form of an emulator; only its weights and normalisation statistics are learnt.

    Each argument may be given as the plain data that `to_dict` makes of it.

    Args:
        scene: The facts of the scenes: channels, dimension, walls; from the command line it comes from the data.
        cells: Grid cells along the longest axis, or along each.
        frames: m, frames predicted by one call of the processor (time bundling).
        transfer: How particles and grid see each other.
        processor: The network on the grid.
        decoder: What the network's output means.
        grid_noise: Standard deviation of the Gaussian noise on the normalised grid state, in training only.
        constraints: Physical limits enforced in rollouts; only `bounds` also in training.
        particles_per_cell: Fewest and most particles in a filled cell of the scenes that it is trained on; None where
            they are all alike, as the scene says.

    Raises ConfigError if scene, grid, processor and constraints do not suit each other.
    """

    scene: Scene
    cells: int | tuple[int, ...] = 64
    frames: int = 8
    transfer: Transfer = Linear()  # noqa: RUF009 (frozen)
    processor: Processor = UNet()  # noqa: RUF009
    decoder: Decoder = Residual()  # noqa: RUF009
    grid_noise: float = 0.0
    constraints: Constraints = Constraints()  # noqa: RUF009
    particles_per_cell: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        scene = self.scene if isinstance(self.scene, Scene) else Scene.from_dict(self.scene)
        given = self.constraints
        read = {
            "scene": scene,
            "cells": Grid.of(scene, self.cells).shape,
            "transfer": from_spec(self.transfer, Transfer),
            "processor": from_spec(self.processor, Processor),
            "decoder": from_spec(self.decoder, Decoder),
            "constraints": given if isinstance(given, Constraints) else from_plain(Constraints, given, "constraints"),
            "particles_per_cell": to_tuples(self.particles_per_cell),
        }
        for name, value in read.items():
            object.__setattr__(self, name, value)
        if self.frames < 1:
            raise ConfigError(f"frames = {self.frames}: a call predicts at least 1 frame.")
        if self.particles_per_cell and not 0 < self.particles_per_cell[0] <= self.particles_per_cell[1]:
            raise ConfigError(f"particles_per_cell = {self.particles_per_cell}: the fewest, then the most.")
        if self.constraints.energy and not self.scene.gravity_known:
            raise ConfigError(
                "constraints.energy needs a scene whose gravity is known: give data.gravity, or switch it off."
            )
        if self.constraints.energy and not self.scene.is_closed:
            warnings.warn("constraints.energy is off: moving obstacles and open axes bring energy in.", stacklevel=3)
            object.__setattr__(self, "constraints", dataclasses.replace(self.constraints, energy=False))
        self.processor.check_grid(self.grid)

    @property
    def grid(self) -> Grid:
        """The grid over the scene's domain."""
        return Grid.of(self.scene, self.cells)

    def build(self) -> Emulator:
        """An emulator of this form, its weights drawn from torch's random state, its statistics not yet calibrated."""
        return Emulator(self)

    def over(self, scene: Scene) -> Self:
        """The recipe for another scene, on a grid with cells of the same size.

        Args:
            scene: Other bounds and domain, finer or coarser particles, perhaps obstacles where there were walls
                already; all else must be the same. Its fields are the emulator's, whatever the scene has.

        Raises:
            ConfigError: if channels, time step, or gravity where the emulator's does not vary, differ, the domain is
                not a whole number of cells, or the processor cannot take the grid.
        """
        scene = scene.with_fields_of(self.scene)
        same_gravity = () if self.scene.gravity_varies else ("gravity",)  # states tell it where it varies
        for name in ("input_channels", "dt", "boundary", *same_gravity):
            if getattr(scene, name) != getattr(self.scene, name):
                raise ConfigError(
                    f"The emulator was made for {name} = {getattr(self.scene, name)}; the other scene has"
                    f" {getattr(scene, name)}."
                )
        spacing = self.grid.spacing
        sides = [(high - low) / h for (low, high), h in zip(scene.domain, spacing, strict=True)]
        if any(abs(side - round(side)) > 1e-4 for side in sides):
            raise ConfigError(
                f"The domain {scene.domain} is {[round(side, 4) for side in sides]} cells of the emulator's grid"
                f" {spacing}; whole numbers are needed."
            )
        return dataclasses.replace(self, scene=scene, cells=tuple(round(side) for side in sides))

    @property
    def turn(self) -> Turn:
        """From the scene's axes to those of the network."""
        processor = self.processor
        return Turn(processor.axes if isinstance(processor, Turned) else tuple("xyz"[: self.scene.dim]))

    def turned(self, turn: Turn) -> Self:
        """The recipe of the same network for the scene in other axes, to which the turn leads from its own."""
        to_network = self.turn.after(turn.inverse)
        network = self.processor.processor if isinstance(self.processor, Turned) else self.processor
        return dataclasses.replace(
            self,
            scene=self.scene.turned(turn),
            cells=turn.permuted(self.grid.shape),
            processor=network if to_network.is_identity else Turned(network, to_network.axes),
        )

    def to_dict(self) -> dict[str, Any]:
        """The recipe as plain lists, strings and numbers, with the version of this form; without what is absent."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        plain = {name: _plain(value) for name, value in values.items() if value is not None}
        return {"format": FORMAT, **plain}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """The recipe that `to_dict` described.

        Raises ConfigError if a newer nmpm wrote it, or a key is missing, unknown or wrong.
        """
        values = dict(plain)
        check_format(values.pop("format", FORMAT), "This model")  # checkpoints state theirs elsewhere
        if missing := sorted({"cells", "frames", "processor"} - set(values)):  # their defaults are for new models
            raise ConfigError(f"The recipe of an emulator lacks {', '.join(missing)}.")
        return from_plain(cls, values, "The recipe of an emulator")


def check_format(version: object, what: str) -> None:
    """Make sure that this version can read a file's format.

    Raises ConfigError if the format is newer, or not a number.
    """
    if not isinstance(version, int) or version > FORMAT:
        raise ConfigError(f"{what} has format {version}; this nmpm reads up to {FORMAT}: use a newer one.")


def _plain(value: Any) -> Any:
    if isinstance(value, Scene):
        return value.to_dict()
    if isinstance(value, Constraints):
        return dataclasses.asdict(value)
    return to_spec(value) if dataclasses.is_dataclass(value) else to_plain(value)
