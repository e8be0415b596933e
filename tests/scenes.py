"""Small scenes and states that several tests start from."""

import torch

from nmpm.emulator import Emulator
from nmpm.particles import Particles
from nmpm.scene import Scene


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


def set_gravity_statistics(emulator: Emulator, **values: list[float]) -> None:
    """Sets statistics of the input channels of gravity, such as `input_std`, to (D,) values in length/s²."""
    channels = [i for i, name in enumerate(emulator.scene.input_channels) if name.startswith("gravity")]
    for name, value in values.items():
        statistic = getattr(emulator, name)
        cells = torch.tensor(value, dtype=torch.float64) * emulator.scene.dt**2 / emulator.grid.spacing[0]
        statistic[channels] = cells.view(-1, *statistic.shape[1:]).to(statistic)
