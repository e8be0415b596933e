"""The emulator: p2g → processor → m times (g2p, advect). One call predicts one bundle of m frames.

Source: Rochman-Sharabi, Lewin & Louppe, A Neural Material Point Method for Particle-based Emulation, arXiv
2408.15753. Transfers, advection and everything else around the processor run in float32 whatever autocast says.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nmpm.advection import Advection, Flight
from nmpm.constraints import Constraints, energy, mass_shares
from nmpm.decoders import Decoder, Residual
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.parallel import normal_like
from nmpm.particles import Particles
from nmpm.processors import GridLayout, Processor, UNet
from nmpm.rasterise import grid_state, solid_fraction, wall_fraction
from nmpm.scene import Scene
from nmpm.transfer import Linear, Transfer

UNLIMITED = 1e30
"""Stands for no limit, finite so that every statistic of a sound model is."""


@dataclass(frozen=True)
class Bundle:
    """The m frames that one call predicts.

    Args:
        position: (B, m, N, D) in domain length, of the precision of the positions that the emulator was given.
        velocity: (B, N, D) at the last frame, in length per frame.
    """

    position: Tensor
    velocity: Tensor


class Emulator(nn.Module):
    """A learned simulator of one family of scenes.

    Args:
        scene: The facts of the scenes; decides channels and dimension.
        cells: Grid cells along the longest axis, or along each.
        frames: m, frames predicted by one call.
        transfer: How particles and grid see each other.
        processor: Recipe of the network between.
        decoder: What the network's output means.
        grid_noise: Standard deviation of the Gaussian noise on the normalised grid state, in training mode only.
        constraints: What it is held to.

    Raises:
        ConfigError: if grid and processor do not suit each other.
    """

    input_mean: Tensor
    input_std: Tensor
    input_low: Tensor
    input_high: Tensor
    output_scale: Tensor
    bounds: Tensor
    walls: Tensor
    calibrated: Tensor

    def __init__(
        self,
        scene: Scene,
        cells: int | Sequence[int] = 64,
        frames: int = 8,
        transfer: Transfer | None = None,
        processor: Processor | None = None,
        decoder: Decoder | None = None,
        grid_noise: float = 0.0,
        constraints: Constraints | None = None,
    ) -> None:
        super().__init__()
        self.scene = scene
        self.constraints = constraints or Constraints()
        if self.constraints.energy and not scene.gravity_known:
            raise ConfigError(
                "constraints.energy needs a scene whose gravity is known: give data.gravity, or switch it off."
            )
        self.frames = frames
        self.grid_noise = grid_noise
        self.grid = Grid.of(scene, cells)
        self.transfer = transfer or Linear()
        self.decoder = decoder or Residual()
        self.recipe = processor or UNet()
        self.recipe.check_grid(self.grid)
        inputs, outputs = len(scene.input_channels), len(scene.output_channels)
        self.processor = self.recipe.build(GridLayout(inputs, outputs, frames, scene.periodic))
        if scene.dim == 2:
            # The layout in which p2g's output comes; twice as fast on a CPU.
            self.processor.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # (torch's stubs lack it)
        column = (1,) * scene.dim
        self.register_buffer("input_mean", torch.zeros(inputs, *column))
        self.register_buffer("input_std", torch.ones(inputs, *column))
        self.register_buffer("input_low", torch.full((inputs, *column), -UNLIMITED))
        self.register_buffer("input_high", torch.full((inputs, *column), UNLIMITED))
        self.register_buffer("output_scale", torch.ones(frames, outputs, *column))
        self.register_buffer("calibrated", torch.zeros((), dtype=torch.bool))
        self.register_buffer("bounds", self.grid.bounds_in_cells(scene), persistent=False)
        self.register_buffer("walls", wall_fraction(scene, self.grid), persistent=False)

    @property
    def precision(self) -> torch.dtype:
        """In which transfers and advection are computed: float32, or float64 after `double()`."""
        return torch.promote_types(self.input_mean.dtype, torch.float32)

    @property
    def advection(self) -> Advection:
        """What moves the particles once the network has spoken."""
        return Advection(self.scene, self.grid, self.transfer, self.decoder, self.constraints, self.bounds, self.walls)

    @property
    def network_precision(self) -> torch.dtype:
        """Of the network's weights; in which it computes, too, unless autocast says otherwise."""
        real = (weight.dtype for weight in self.processor.parameters() if weight.is_floating_point())
        return next(real, self.precision)

    def with_network(self, precision: torch.dtype) -> Emulator:
        """This emulator if its network has weights of this type, else a copy that has; all but the network stays.

        Raises:
            ConfigError: if the network has complex weights, as FNOs do, which have no such type.
        """
        if precision == self.network_precision:
            return self
        if any(weight.is_complex() for weight in self.processor.parameters()):
            raise ConfigError(
                f"{type(self.recipe).__name__} has complex weights, which cannot be {precision}: use torch.autocast."
            )
        other = copy.deepcopy(self)
        other.processor.to(precision)
        return other

    def over(self, scene: Scene) -> Emulator:
        """The same emulator in another box: a copy of weights and statistics, on a grid with cells of the same size.

        Args:
            scene: Other bounds and domain, finer or coarser particles, perhaps obstacles where there were walls
                already; all else must be the same.

        Raises:
            ConfigError: if channels, time step or gravity differ, the domain is not a whole number of cells, or the
                processor cannot take the grid.
        """
        mine = self.scene
        for name in ("input_channels", "dt", "boundary", "gravity"):
            if getattr(scene, name) != getattr(mine, name):
                raise ConfigError(
                    f"The emulator was made for {name} = {getattr(mine, name)}; the other scene has"
                    f" {getattr(scene, name)}."
                )
        sides = [(high - low) / h for (low, high), h in zip(scene.domain, self.grid.spacing, strict=True)]
        if any(abs(side - round(side)) > 1e-4 for side in sides):
            raise ConfigError(
                f"The domain {scene.domain} is {[round(side, 4) for side in sides]} cells of the emulator's grid"
                f" {self.grid.spacing}; whole numbers are needed."
            )
        cells = [round(side) for side in sides]
        other = Emulator(
            scene, cells, self.frames, self.transfer, self.recipe, self.decoder, self.grid_noise, self.constraints
        )
        other.load_state_dict(self.state_dict())
        other.to(self.calibrated.device)
        return other.train(self.training)

    def solid(self, particles: Particles) -> Tensor:
        """What of each cell is wall or obstacle, (B, C_solid, *S), C_solid 0 or 1. Once per scene, not per step."""
        return solid_fraction(self.scene, self.grid, self.transfer, particles, self.walls)

    def budget(self, particles: Particles) -> Tensor | None:
        """The energy (B,) that a rollout from this state is held to; None where it is not."""
        if not self.constraints.energy or self.training:
            return None
        cells, velocity, gravity = self.grid.isotropic_units(*self.in_cells(particles))
        share = mass_shares(self.scene, particles.material, particles.mask, cells.dtype)
        return energy(cells, velocity, gravity, share)

    def normalised(self, state: Tensor) -> Tensor:
        """What the processor sees of a grid state (B, C_in, *S) in grid units."""
        # Beyond what training saw, a network's answers are arbitrary and may be huge.
        seen = torch.maximum(torch.minimum(state, self.input_high), self.input_low)
        return (seen - self.input_mean) / self.input_std

    def forward(self, particles: Particles, solid: Tensor, budget: Tensor | None = None) -> Bundle:
        """Predict the next m frames.

        Args:
            particles: The state to start from.
            solid: (B, C_solid, *S), from `solid`.
            budget: (B,) energy not to be exceeded, from `budget` of the rollout's first state.
        """
        device = particles.position.device.type
        with torch.autocast(device, enabled=False):
            cells, velocity, gravity = self.in_cells(particles)
            state = grid_state(self.scene, self.grid, self.transfer, particles, cells, velocity, solid)
            normalised = self.normalised(state)
            if self.training and self.grid_noise > 0:
                normalised = normalised + self.grid_noise * normal_like(normalised)
        output = self.processor(normalised.to(self.network_precision))
        with torch.autocast(device, enabled=False):
            fields = output.to(self.precision) * self.output_scale
            advection = self.advection
            smoothed = advection.gather(state[:, : fields.shape[2]], cells, particles.material)
            carried = self.decoder.carried(velocity, smoothed)
            share = mass_shares(self.scene, particles.material, particles.mask, cells.dtype)
            flight = Flight(cells, velocity, carried, gravity, particles.material, fields, share)
            path = advection.free_path(flight) if self.training else advection.constrained_path(flight, solid, budget)
            steps = path.diff(dim=1, prepend=cells.unsqueeze(1))
            precision = particles.position.dtype
            return Bundle(
                position=self.grid.to_length(path.to(precision)),
                velocity=self.grid.to_displacement(steps[:, -1].to(precision)),
            )

    def in_cells(self, particles: Particles) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (B, N, D), velocities (B, N, D) and gravity (B, 1, D) in grid units."""
        return (
            self.grid.to_cells(particles.position, self.precision),
            self.grid.to_cell_displacement(particles.velocity, self.precision),
            self.grid.to_cell_displacement(particles.gravity, self.precision).unsqueeze(1),
        )
