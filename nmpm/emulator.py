"""The emulator: p2g → processor → m times (g2p, advect). One call predicts one bundle of m frames.

Source: Rochman-Sharabi, Lewin & Louppe, A Neural Material Point Method for Particle-based Emulation, arXiv
2408.15753. Transfers, advection and everything else around the processor run in float32 whatever autocast says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nmpm.decoders import Decoder, Residual
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Particles, Window
from nmpm.processors import GridLayout, Processor, UNet
from nmpm.rasterise import grid_state, solid_fraction, wall_fraction
from nmpm.scene import Scene
from nmpm.transfer import Linear, Transfer


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

    Raises:
        ConfigError: if grid and processor do not suit each other.
    """

    input_mean: Tensor
    input_std: Tensor
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
    ) -> None:
        super().__init__()
        self.scene = scene
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
        self.register_buffer("output_scale", torch.ones(frames, outputs, *column))
        self.register_buffer("calibrated", torch.zeros((), dtype=torch.bool))
        limits = torch.tensor(scene.bounds, dtype=torch.float64)
        lower, spacing = torch.tensor(self.grid.lower).double(), torch.tensor(self.grid.spacing).double()
        self.register_buffer("bounds", ((limits.T - lower) / spacing).float(), persistent=False)
        self.register_buffer("walls", wall_fraction(scene, self.grid), persistent=False)

    def over(self, scene: Scene) -> Emulator:
        """The same emulator in another box: a copy of weights and statistics, on a grid with cells of the same size.

        Args:
            scene: Other bounds and domain, perhaps obstacles where there were walls already; all else must be the same.

        Raises:
            ConfigError: if channels, time step or the sizes of particles differ, the domain is not a whole number of
                cells, or the processor cannot take the grid.
        """
        mine = self.scene
        for name in ("input_channels", "dt", "particle_volume", "boundary", "gravity"):
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
        other = Emulator(scene, cells, self.frames, self.transfer, self.recipe, self.decoder, self.grid_noise)
        other.load_state_dict(self.state_dict())
        other.to(self.calibrated.device)
        return other.train(self.training)

    def solid(self, particles: Particles) -> Tensor:
        """What of each cell is wall or obstacle, (B, C_solid, *S), C_solid 0 or 1. Once per scene, not per step."""
        return solid_fraction(self.scene, self.grid, self.transfer, particles, self.walls)

    def forward(self, particles: Particles, solid: Tensor) -> Bundle:
        """Predict the next m frames.

        Args:
            particles: The state to start from.
            solid: (B, C_solid, *S), from `solid`.
        """
        device = particles.position.device.type
        with torch.autocast(device, enabled=False):
            cells = self.grid.to_cells(particles.position)
            velocity = self.grid.to_cell_displacement(particles.velocity)
            state = grid_state(self.scene, self.grid, self.transfer, particles, cells, velocity, solid)
            normalised = (state - self.input_mean) / self.input_std
            if self.training and self.grid_noise > 0:
                normalised = normalised + self.grid_noise * torch.randn_like(normalised)
        output = self.processor(normalised)
        with torch.autocast(device, enabled=False):
            fields = output.float() * self.output_scale
            return self._advect(particles, cells, velocity, state, fields)

    def _advect(self, particles: Particles, cells: Tensor, velocity: Tensor, state: Tensor, fields: Tensor) -> Bundle:
        material = particles.material
        gravity = self.grid.to_cell_displacement(particles.gravity).unsqueeze(1)
        smoothed = self._gather(state[:, : fields.shape[2]], cells, material)
        carried = velocity = self.decoder.carried(velocity, smoothed)
        path = []
        for frame, field in enumerate(fields.unbind(1), start=1):  # indexing would cost a zero-fill each, backwards
            known = self.decoder.known(carried, velocity, gravity, frame)
            step = known + self._gather(field, cells, material)
            arrived = self._confine(cells + step)
            velocity = arrived - cells
            cells = arrived
            path.append(cells)
        precision = particles.position.dtype
        return Bundle(
            position=self.grid.to_length(torch.stack(path, dim=1).to(precision)),
            velocity=self.grid.to_displacement(velocity.to(precision)),
        )

    def _gather(self, fields: Tensor, cells: Tensor, material: Tensor) -> Tensor:
        """Each particle's own material's velocity: fields (B, materials * D, *S) at cells (B, N, D) → (B, N, D)."""
        gathered = self.transfer.g2p(fields, cells, self.grid)
        if len(self.scene.materials) == 1:
            return gathered
        split = gathered.unflatten(-1, (len(self.scene.materials), self.scene.dim))
        chosen = material[..., None, None].expand(-1, -1, 1, self.scene.dim)
        own: Tensor = split.gather(2, chosen).squeeze(2)
        return own

    def _confine(self, cells: Tensor) -> Tensor:
        """Stop particles at the walls; periodic axes go on (positions there are unwrapped, transfers wrap)."""
        if all(self.scene.periodic):
            return cells
        held = torch.maximum(torch.minimum(cells, self.bounds[1]), self.bounds[0])
        wraps = torch.tensor(self.scene.periodic, device=cells.device)
        return torch.where(wraps, cells, held) if any(self.scene.periodic) else held

    @torch.no_grad()
    def calibrate(self, windows: Sequence[Window]) -> None:
        """Set the normalisation statistics from a sample of training windows of at least m + 2 frames.

        Inputs get mean and standard deviation per channel over all cells; outputs the root mean square of what is
        left of the true velocities once the decoder's known part is taken out, per frame of the bundle and component.

        Raises:
            ValueError: if there is no window or one is too short.
        """
        if not windows or min(window.target.shape[1] for window in windows) < self.frames:
            raise ValueError(f"Calibration needs windows of at least {self.frames + 2} frames.")
        state = torch.cat([self._state(window.initial) for window in windows])
        axes = (0, *range(2, state.dim()))
        self.input_mean.copy_(state.mean(axes).reshape_as(self.input_mean))
        self.input_std.copy_(_nonzero(state.std(axes)).reshape_as(self.input_std))
        self.output_scale.copy_(self._unknown_scale(windows).reshape_as(self.output_scale))
        self.calibrated.fill_(True)

    def _state(self, particles: Particles) -> Tensor:
        cells = self.grid.to_cells(particles.position)
        velocity = self.grid.to_cell_displacement(particles.velocity)
        return grid_state(self.scene, self.grid, self.transfer, particles, cells, velocity, self.solid(particles))

    def _unknown_scale(self, windows: Sequence[Window]) -> Tensor:
        """(m, C_out): root mean square of the part of the velocity that the network has to give."""
        unknown = [self._unknown(window) for window in windows]
        scales = []
        for index in range(len(self.scene.materials)):
            chosen = [window.mask & (window.material == index) for window in windows]
            values = torch.cat([part.transpose(1, 2)[of] for part, of in zip(unknown, chosen, strict=True)])
            scales.append(values.square().mean(0).sqrt().nan_to_num(1.0))
        return _nonzero(torch.cat(scales, dim=-1))

    def _unknown(self, window: Window) -> Tensor:
        """(B, m, N, D) true velocities less what the decoder knows, in cells per frame."""
        steps = self.grid.to_cell_displacement(window.frames[:, 1:].diff(dim=1))[:, : self.frames]
        velocity = self.grid.to_cell_displacement(window.initial.velocity)
        gravity = self.grid.to_cell_displacement(window.gravity).unsqueeze(1)
        carried = self.decoder.carried(velocity, velocity)
        before = [carried, *steps.unbind(1)]
        known = [self.decoder.known(carried, before[frame - 1], gravity, frame) for frame in range(1, self.frames + 1)]
        return steps - torch.stack(known, dim=1)


def _nonzero(scale: Tensor) -> Tensor:
    """Scales that can be divided by: a channel that never varies is left as it is."""
    return torch.where(scale > 1e-12, scale, torch.ones_like(scale))
