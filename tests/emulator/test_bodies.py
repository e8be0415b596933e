"""Bodies on the grid: the exact share of each cell on average, smooth, and with gradients through whole rollouts."""

import dataclasses
import math

import pytest
import torch
from scenes import box, cloud

from nmpm.emulator import Emulator, EmulatorRecipe, differentiable_rollout
from nmpm.emulator.bodies import sample_bodies, solid_share
from nmpm.emulator.constraints import Constraints
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.obstacles import Body, Box, Disc, Polygon, Ramp, Sphere
from nmpm.particles import Particles
from nmpm.processors import UNet
from nmpm.scene import Scene

FRAMES = 5
SCENE = box(obstacles=True)
TRIANGLE = (0.3, 0.3, 0.7, 0.35, 0.5, 0.55)
FAMILIES = {
    "ramp": (
        lambda x, y, length, thickness, angle: Ramp((x, y), length, thickness, angle),
        (0.5, 0.35, 0.3, 0.07, 0.4),
    ),
    "disc": (lambda x, y, radius: Disc((x, y), radius), (0.5, 0.4, 0.11)),
    "polygon": (lambda *given: Polygon([given[:2], given[2:4], given[4:]]), TRIANGLE),
}
every_family = pytest.mark.parametrize(("make", "parameters"), FAMILIES.values(), ids=FAMILIES)


def emulator(scene: Scene = SCENE, **constraints) -> Emulator:
    torch.manual_seed(0)
    recipe = EmulatorRecipe(scene, 32, frames=2, processor=UNet(4, 1), constraints=Constraints(**constraints))
    return recipe.build().double().eval().requires_grad_(False)


def state(model: Emulator, *scenes: list[Body]) -> Particles:
    """In float64, with the bodies of each scene."""
    scenes = scenes or ([],)
    particles = cloud(model.scene, 12, batch=len(scenes))
    points, share = sample_bodies(scenes, model.scene, model.grid)
    given = {name: getattr(particles, name).double() for name in ("position", "velocity", "gravity")}
    return dataclasses.replace(
        particles,
        **given,
        obstacle=points.expand(len(scenes), -1, -1),
        obstacle_mask=torch.ones(share.shape, dtype=torch.bool),
        obstacle_share=share,
    )


def obstacle_field(model: Emulator, *bodies: Body) -> torch.Tensor:
    """(*S) share of each cell that bodies take, without the walls."""
    return (model.solid(state(model, list(bodies))) - model.walls)[0, 0]


def leaves(parameters: tuple[float, ...]) -> list[torch.Tensor]:
    return [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in parameters]


def test_the_share_is_smooth_and_keeps_the_area_of_what_it_smooths():
    distance = torch.linspace(-1, 1, 2001, dtype=torch.float64, requires_grad=True)
    share = solid_share(distance, 0.5)
    assert (share[distance <= -0.2501] == 1).all()
    assert (share[distance >= 0.2501] == 0).all()
    assert float(share.detach().mean()) == pytest.approx(0.5)
    (slope,) = torch.autograd.grad(share.sum(), distance)
    assert slope.diff().abs().max() < 0.05
    assert float(slope.min()) == pytest.approx(-3.0, abs=1e-3)  # -3/2 over the width


@every_family
def test_the_cells_hold_the_area_of_a_body(make, parameters):
    model = emulator()
    areas = {"Ramp": 0.3 * 0.07, "Disc": math.pi * 0.11**2, "Polygon": 0.5 * (0.4 * 0.25 - 0.2 * 0.05)}
    body = make(*parameters)
    area = float(obstacle_field(model, body).sum()) * model.grid.cell_volume
    assert area == pytest.approx(areas[type(body).__name__], rel=0.02)


@every_family
def test_gradients_of_every_parameter_are_those_of_finite_differences(make, parameters):
    """Through p2g, the network and several bundles, without the constraints, which have kinks."""
    model = emulator(solids=False)
    weight = torch.randn(12, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def loss(*given: torch.Tensor) -> torch.Tensor:
        end = differentiable_rollout(model, state(model, [make(*given)]), FRAMES)[:, -1]
        return 1e4 * (end * weight).sum()

    values = leaves(parameters)
    assert torch.autograd.gradcheck(loss, values, eps=1e-6, atol=1e-6, rtol=2e-3)
    for slope in torch.autograd.grad(loss(*values), values):
        assert slope.abs() > 1e-4  # far above the tolerance


@pytest.mark.parametrize(("dim", "body"), [(3, Disc((0.5, 0.5), 0.1)), (2, Sphere((0.5, 0.5, 0.5), 0.1))])
def test_bodies_have_the_dimensions_of_the_scene(dim, body):
    scene = box(dim, obstacles=True)
    with pytest.raises(ConfigError, match=f"and this model's scenes have {dim}: Ramp, Disc and Polygon are for two"):
        sample_bodies([[body]], scene, Grid.of(scene, 8))


SPACE = {
    "box": (
        lambda *given: Box(given[:3], given[3:6], given[6:]),
        (0.5, 0.45, 0.5, 0.4, 0.3, 0.2, 0.3, -0.2, 0.1),
        0.4 * 0.3 * 0.2,
    ),
    "sphere": (lambda *given: Sphere(given[:3], given[3]), (0.5, 0.45, 0.5, 0.2), 4 / 3 * math.pi * 0.2**3),
}
every_body_in_space = pytest.mark.parametrize(("make", "parameters", "volume"), SPACE.values(), ids=SPACE)


def model_in_space(**constraints) -> Emulator:
    torch.manual_seed(0)
    recipe = EmulatorRecipe(
        box(3, obstacles=True), 12, frames=2, processor=UNet(4, 1), constraints=Constraints(**constraints)
    )
    return recipe.build().double().eval().requires_grad_(False)


@every_body_in_space
def test_the_cells_hold_the_volume_of_a_body_in_space(make, parameters, volume):
    model = model_in_space()
    field = (model.solid(state(model, [make(*parameters)])) - model.walls)[0, 0]
    assert float(field.sum()) * model.grid.cell_volume == pytest.approx(volume, rel=0.03)
    assert float(field.max()) == pytest.approx(1.0)
