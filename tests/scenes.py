"""Small scenes, states and emulators that several tests start from."""

import dataclasses

import torch
from torch import Tensor

from nmpm.decoders import Decoder, Residual
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.particles import Particles, Window
from nmpm.processors import Pointwise, Processor
from nmpm.scene import Scene
from nmpm.transfer import Linear, Transfer

CHANNEL = {"boundary": ("periodic", "wall"), "domain": ((0.1, 0.9), (0.08, 0.92))}
"""Changes of `box()`: periodic along the first axis."""


def box(dim: int = 2, materials: tuple[str, ...] = ("goop",), **changes) -> Scene:
    facts = {
        "bounds": ((0.1, 0.9),) * dim,
        "domain": ((0.08, 0.92),) * dim,
        "dt": 0.0025,
        "materials": materials,
        "particle_volume": 0.02**dim,
        "gravity": (0.0,) * (dim - 1) + (-9.81,),
    }
    return Scene(**(facts | changes))


def cloud(
    scene: Scene, count: int = 30, batch: int = 1, speed: float = 0.002, seed: int = 0, statics: int = 0
) -> Particles:
    """Random particles in the middle of the box, moving slowly."""
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, count, scene.dim)
    return Particles(
        position=0.3 + 0.4 * torch.rand(shape, generator=generator),
        velocity=speed * torch.randn(shape, generator=generator),
        material=torch.randint(len(scene.materials), (batch, count), generator=generator),
        mask=torch.ones(batch, count, dtype=torch.bool),
        obstacle=0.2 + 0.6 * torch.rand((batch, statics, scene.dim), generator=generator),
        obstacle_mask=torch.ones(batch, statics, dtype=torch.bool),
        gravity=torch.tensor(scene.gravity or (0.0,) * scene.dim).expand(batch, -1) * scene.dt**2,
    )


def emulator_of(
    scene: Scene,
    cells: int | tuple[int, ...] = 16,
    frames: int = 4,
    transfer: Transfer = Linear(),
    processor: Processor = Pointwise(hidden=(8,)),
    decoder: Decoder = Residual(),
    scale: float = 1.0,
    seed: int = 0,
    **constraints,
) -> Emulator:
    """An emulator in evaluation mode, with random weights and `scale` as the scale of all outputs."""
    torch.manual_seed(seed)
    held = Constraints(**constraints)
    emulator = EmulatorRecipe(scene, cells, frames, transfer, processor, decoder, constraints=held).build().eval()
    emulator.output_scale.fill_(scale)
    return emulator


def silenced(emulator: Emulator) -> Emulator:
    """The emulator with a network that always says zero."""
    for parameter in emulator.processor.parameters():
        torch.nn.init.zeros_(parameter)
    return emulator


def with_obstacle(state: Particles, points: Tensor) -> Particles:
    """The state with an obstacle of points (K, D) in each of its scenes."""
    points = points.to(state.position).expand(len(state.position), -1, -1)
    return dataclasses.replace(state, obstacle=points, obstacle_mask=torch.ones(points.shape[:2], dtype=torch.bool))


def padded(state: Particles, position: Tensor, velocity: float = 0.3, field: float = 1e30) -> Particles:
    """The state with padding at positions (K, D), which moves fast."""
    batch, count = len(state.position), len(position)

    def pad(values: Tensor, number: float) -> Tensor:
        return torch.cat([values, values.new_full((batch, count, *values.shape[2:]), number)], dim=1)

    fields = {name: values if values.shape[1] == 1 else pad(values, field) for name, values in state.fields.items()}
    return dataclasses.replace(
        state,
        position=torch.cat([state.position, position.to(state.position).expand(batch, -1, -1)], dim=1),
        velocity=pad(state.velocity, velocity),
        material=pad(state.material, 0),
        mask=pad(state.mask, False),
        fields=fields,
    )


def window_of(state: Particles, frames: Tensor) -> Window:
    """A window (B, T, N, D) of the particles, obstacles and gravity of a state."""
    return Window(
        frames, state.material, state.mask, state.obstacle, state.obstacle_mask, state.gravity, dict(state.fields),
        volume=state.volume,
    )  # fmt: skip


def set_gravity_statistics(emulator: Emulator, **values: list[float]) -> None:
    """Sets statistics of the input channels of gravity, such as `input_std`, to (D,) values in length/s²."""
    channels = [i for i, name in enumerate(emulator.scene.input_channels) if name.startswith("gravity")]
    for name, value in values.items():
        statistic = getattr(emulator, name)
        cells = torch.tensor(value, dtype=torch.float64) * emulator.scene.dt**2 / emulator.grid.spacing[0]
        statistic[channels] = cells.view(-1, *statistic.shape[1:]).to(statistic)
