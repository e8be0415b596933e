"""Parts of an emulator as functions of plain tensors, which `torch.export` can follow.

They call the emulator itself. Only what a program cannot decide at run time is fixed here: all particles are real,
sums are torch's own, nothing is trained.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from nmpm.emulator import Emulator, RolloutContext
from nmpm.emulator.engines.rules import EXPORTS, refusal
from nmpm.emulator.rasterise import wall_fraction
from nmpm.errors import ConfigError
from nmpm.particles import Particles

VARYING = {"B": 2, "N": 7, "M": 7}
"""Sizes that an exported part leaves open (scenes, particles, obstacle particles), with their values in examples:
neither 0 nor 1, which torch.export takes for constants."""


@dataclass(frozen=True)
class Value:
    """An input or output tensor.

    Args:
        name: Its name in the file.
        shape: Its sizes, those that vary by their name in `VARYING`.
        description: Its meaning, with its unit.
        scale: Of an output: what one cell is in its unit, or 1.
    """

    name: str
    shape: tuple[str | int, ...]
    description: str
    scale: float = 1.0


class ExportedPart(nn.Module, ABC):
    """An exportable function of named float32 tensors, with a copy of the emulator on the CPU; `to` moves it.

    Args:
        emulator: On any device; it is left there.

    Raises:
        ConfigError: if the emulator has what the part does not carry, see `nmpm.emulator.engines.rules`.
    """

    features: ClassVar[frozenset[str]] = frozenset()
    """Those of `EXPORTS` that it carries."""
    inputs: tuple[Value, ...]
    outputs: tuple[Value, ...]

    def __init__(self, emulator: Emulator) -> None:
        super().__init__()
        if reason := refusal(EXPORTS, emulator, self.features):
            raise ConfigError(f"The model has what exported files do not carry: {reason}.")
        self.emulator = copy.deepcopy(emulator.with_runtime("eager")).cpu().float().eval().requires_grad_(False)

    @property
    def device(self) -> torch.device:
        """Where the part computes."""
        return self.emulator.device

    @abstractmethod
    def example(self, batch: int, count: int, seed: int = 0) -> dict[str, Tensor]:
        """Random inputs on the part's device, for tracing and comparing: of scenes, and particles of each kind."""


class Step(ExportedPart):
    """One call of the emulator: from a state to the next m frames and the state after them.

    Raises:
        ConfigError: if the emulator raises errors at the bounds, which a program cannot.
    """

    def __init__(self, emulator: Emulator) -> None:
        super().__init__(emulator)
        scene, shape = emulator.scene, emulator.grid.shape
        state: tuple[str | int, ...] = ("B", "N", scene.dim)
        names = ", ".join(f"{index} {name}" for index, name in enumerate(scene.materials))
        budget = "energy per mass not to be exceeded, in cells and frames; nan for that of this state, inf for no limit"
        possible = {
            "position": Value("position", state, "domain length"),
            "velocity": Value("velocity", state, "domain length per frame"),
            "material": Value("material", ("B", "N"), f"index of each particle's material: {names}"),
            "gravity": Value("gravity", ("B", scene.dim), "domain length per frame squared"),
            "solid": Value("solid", ("B", 1, *shape), "share of each cell that is wall or obstacle, from 0 to 1"),
            "budget": Value("budget", ("B",), budget),
        }
        needed = {
            "material": len(scene.materials) > 1,
            "gravity": scene.gravity_varies,
            "solid": scene.obstacles,
            "budget": emulator.constraints.energy,
        }
        self.inputs = tuple(value for name, value in possible.items() if needed.get(name, True))
        cell, following = min(emulator.grid.spacing), "at the last frame, in domain length per frame: the next call's"
        frames = ("B", emulator.frames, "N", scene.dim)
        positions = Value("positions", frames, "the next frames, in domain length", cell)
        velocity = Value("next_velocity", state, following, cell)
        kept = Value("next_budget", ("B",), "the budget that was kept: the next call's")
        self.outputs = (positions, velocity, kept) if emulator.constraints.energy else (positions, velocity)
        known = torch.tensor(scene.gravity or (0.0,) * scene.dim) * scene.dt**2
        self.register_buffer("known_gravity", known, persistent=False)

    known_gravity: Tensor

    def forward(
        self,
        position: Tensor,
        velocity: Tensor,
        material: Tensor | None = None,
        gravity: Tensor | None = None,
        solid: Tensor | None = None,
        budget: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """The outputs for the inputs that this emulator needs."""
        state = self._state(position, velocity, material, gravity)
        solid = self.emulator.solid(state) if solid is None else solid
        current = self.emulator.budget(state)
        if current is None or budget is None:
            bundle = self.emulator(state, RolloutContext(solid, current))
            return bundle.position, bundle.velocity
        kept = torch.where(budget.isnan(), current, budget)
        bundle = self.emulator(state, RolloutContext(solid, kept))
        return bundle.position, bundle.velocity, kept

    def _state(self, position: Tensor, velocity: Tensor, material: Tensor | None, gravity: Tensor | None) -> Particles:
        batch, count, dim = position.shape
        if material is None:
            material = torch.zeros(batch, count, dtype=torch.int64, device=position.device)
        if gravity is None:
            gravity = self.known_gravity.expand(batch, dim)
        return _real_state(position, velocity, material, position.new_zeros(batch, 0, dim), gravity)

    def example(self, batch: int, count: int, seed: int = 0) -> dict[str, Tensor]:
        random = torch.Generator().manual_seed(seed)
        scene, grid = self.emulator.scene, self.emulator.grid
        low, high = torch.tensor(scene.bounds).T
        spread = 0.5 * torch.tensor(grid.spacing)
        values = {
            "position": low + (high - low) * torch.rand(batch, count, scene.dim, generator=random),
            "velocity": spread * torch.randn(batch, count, scene.dim, generator=random),
            "material": torch.randint(len(scene.materials), (batch, count), generator=random),
            "gravity": (torch.tensor(scene.gravity or (0.0,) * scene.dim) * scene.dt**2).repeat(batch, 1),
            "solid": wall_fraction(scene, grid).expand(batch, 1, *grid.shape).clone(),
            "budget": torch.full((batch,), float("nan")),
        }
        return {value.name: values[value.name].to(self.device) for value in self.inputs}


class Network(ExportedPart):
    """The network between the transfers with its normalisation: from a grid state to m grid velocity fields."""

    features = frozenset({"bounds: error"})

    def __init__(self, emulator: Emulator) -> None:
        super().__init__(emulator)
        scene, shape = emulator.scene, emulator.grid.shape
        channels = ", ".join(scene.input_channels)
        description = f"channels {channels}; velocities in cells per frame, volumes and solids as shares of a cell"
        decoder = type(emulator.decoder).__name__
        self.inputs = (Value("grid", ("B", len(scene.input_channels), *shape), description),)
        out: tuple[str | int, ...] = ("B", emulator.frames, len(scene.output_channels), *shape)
        fields = f"channels {', '.join(scene.output_channels)}, in cells per frame, for the decoder {decoder}"
        self.outputs = (Value("fields", out, fields),)

    def forward(self, grid: Tensor) -> tuple[Tensor]:
        """(B, C_in, *S) → (B, m, C_out, *S)."""
        fields: Tensor = self.emulator.processor(self.emulator.normalise(grid)) * self.emulator.output_scale
        return (fields,)

    def example(self, batch: int, count: int, seed: int = 0) -> dict[str, Tensor]:  # noqa: ARG002 (no particles here)
        """Grid states with the mean and standard deviation of the emulator's inputs."""
        emulator = self.emulator
        shape = (batch, len(emulator.scene.input_channels), *emulator.grid.shape)
        noise = torch.randn(shape, generator=torch.Generator().manual_seed(seed)).to(self.device)
        return {"grid": emulator.input_mean + emulator.input_std * noise}


class Solid(ExportedPart):
    """From obstacle particles to the solid fraction that the step takes.

    Raises:
        ConfigError: if the scene has no obstacles.
    """

    features = frozenset({"bounds: error"})

    def __init__(self, emulator: Emulator) -> None:
        super().__init__(emulator)
        scene = emulator.scene
        if not scene.obstacles:
            raise ConfigError("The model's scene has no obstacles: export its step alone.")
        description = f"particles that fill the obstacles, each of volume {scene.particle_volume:g}, in domain length"
        self.inputs = (Value("obstacle", ("B", "M", scene.dim), description),)
        share = "share of each cell that is wall or obstacle, from 0 to 1"
        self.outputs = (Value("solid", ("B", 1, *emulator.grid.shape), share),)

    def forward(self, obstacle: Tensor) -> tuple[Tensor]:
        """(B, M, D) → (B, 1, *S)."""
        batch, _, dim = obstacle.shape
        none, gravity = obstacle.new_zeros(batch, 0, dim), obstacle.new_zeros(batch, dim)
        return (self.emulator.solid(_real_state(none, none, none[..., 0].long(), obstacle, gravity)),)

    def example(self, batch: int, count: int, seed: int = 0) -> dict[str, Tensor]:
        scene, random = self.emulator.scene, torch.Generator().manual_seed(seed)
        low, high = torch.tensor(scene.bounds).T
        obstacle = low + (high - low) * torch.rand(batch, count, scene.dim, generator=random)
        return {"obstacle": obstacle.to(self.device)}


def _real_state(position: Tensor, velocity: Tensor, material: Tensor, obstacle: Tensor, gravity: Tensor) -> Particles:
    """A state of which all particles are real."""
    mask, obstacle_mask = (
        torch.ones(points.shape[:2], dtype=torch.bool, device=points.device) for points in (position, obstacle)
    )
    return Particles(position, velocity, material, mask, obstacle, obstacle_mask, gravity)
