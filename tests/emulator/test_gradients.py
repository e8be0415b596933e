"""Gradients through whole rollouts, of states and of the parameters of bodies; the bodies' shares of cells."""

import dataclasses
import math

import pytest
import torch

from nmpm.emulator import Emulator, differentiable_rollout
from nmpm.emulator.bodies import BAND, SAMPLES, lattice, sample_bodies, solid_share
from nmpm.emulator.rasterise import grid_state
from nmpm.errors import ConfigError, DataError
from nmpm.grid import Grid
from nmpm.obstacles import Body, Box, Disc, Polygon, Ramp, Sphere
from nmpm.particles import Particles
from nmpm.processors import UNet
from nmpm.scene import Scene
from nmpm.transfer import Quadratic
from tests.scenes import box, cloud, emulator_of, with_obstacle

FRAMES = 5  # of which the last bundle is cut
SCENE = box(obstacles=True, gravity=None, gravity_varies=True)
BODIES = {
    "ramp": (lambda x, y, *form: Ramp((x, y), *form), (0.5, 0.35, 0.3, 0.07, 0.4), 0.3 * 0.07),
    "disc": (lambda x, y, radius: Disc((x, y), radius), (0.5, 0.4, 0.11), math.pi * 0.11**2),
    "polygon": (
        lambda *ends: Polygon([ends[:2], ends[2:4], ends[4:]]),
        (0.3, 0.3, 0.7, 0.35, 0.5, 0.55),
        0.5 * (0.4 * 0.25 - 0.2 * 0.05),
    ),
    "box": (
        lambda *form: Box(form[:3], form[3:6], form[6:]),
        (0.5, 0.45, 0.5, 0.4, 0.3, 0.2, 0.3, -0.2, 0.1),
        0.4 * 0.3 * 0.2,
    ),
    "sphere": (lambda *form: Sphere(form[:3], form[3]), (0.5, 0.45, 0.5, 0.2), 4 / 3 * math.pi * 0.2**3),
}
every_body = pytest.mark.parametrize("name", BODIES)
every_flat_body = pytest.mark.parametrize("name", ["ramp", "disc", "polygon"])


def emulator(scene: Scene = SCENE, cells: int = 16, **constraints) -> Emulator:
    """In float64, for finite differences; smooth: its linear interpolation has kinks, which they rarely meet."""
    return emulator_of(scene, cells, 2, processor=UNet(4, 1), **constraints).double().requires_grad_(False)


def state(model: Emulator, *bodies: Body, count: int = 12) -> Particles:
    """In float64, with bodies."""
    points, share = sample_bodies([bodies], model.scene, model.grid)
    gravity = torch.tensor([[0.0] * (model.scene.dim - 1) + [-6e-5]], dtype=torch.float64)
    particles = dataclasses.replace(cloud(model.scene, count).double(), gravity=gravity)
    return dataclasses.replace(with_obstacle(particles, points), obstacle_share=share)


def leaves(parameters: tuple[float, ...]) -> list[torch.Tensor]:
    return [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in parameters]


def loss(model: Emulator, particles: Particles) -> torch.Tensor:
    end = differentiable_rollout(model, particles, FRAMES)[:, -1]
    weight = torch.randn(end.shape[1:], dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return 1e4 * (end * weight).sum()


def test_gradients_are_finite_where_a_node_sees_next_to_nothing_of_a_lone_particle():
    scene = box(3)
    model = emulator_of(scene, 8, transfer=Quadratic())
    cells = torch.full((1, 1, 3), 2.0).nextafter(torch.zeros(())).requires_grad_()  # at the rim of node 0's support
    velocity = torch.ones(1, 1, 3, requires_grad=True)
    state = grid_state(
        scene, model.grid, model.transfer, cloud(scene, 1), cells, velocity, model.walls[None, None][:, :0]
    )
    assert 0 < state[0, 3, 0, 0, 0] < 1e-38
    for slope in torch.autograd.grad(state[:, :3].square().sum(), (cells, velocity)):
        assert slope.abs().max() < 1e9  # rounding over the distance to the rim


# ---- bodies


def test_the_share_is_smooth_and_keeps_the_area_of_what_it_smooths():
    distance = torch.linspace(-1, 1, 2001, dtype=torch.float64, requires_grad=True)
    share = solid_share(distance, 0.5)
    assert float(share.detach().mean()) == pytest.approx(0.5)
    (slope,) = torch.autograd.grad(share.sum(), distance)
    assert slope.diff().abs().max() < 0.05


@every_body
def test_the_cells_hold_the_volume_of_a_body(name):
    make, parameters, volume = BODIES[name]
    body = make(*parameters)
    model = emulator(box(body.dim, obstacles=True), 32 if body.dim == 2 else 12)
    field = (model.solid(state(model, body)) - model.walls)[0, 0]
    assert float(field.sum()) * model.grid.cell_volume == pytest.approx(volume, rel=0.03)


@every_flat_body
def test_gradients_of_every_parameter_are_those_of_finite_differences(name):
    """Through p2g, the network and several bundles, without the constraints, which have kinks."""
    make, parameters, _ = BODIES[name]
    model, values = emulator(cells=32, solids=False), leaves(parameters)

    def of(*parameters: torch.Tensor) -> torch.Tensor:
        return loss(model, state(model, make(*parameters)))

    assert torch.autograd.gradcheck(of, values, eps=1e-6, atol=1e-6, rtol=2e-3)
    for slope in torch.autograd.grad(of(*values), values):
        assert slope.abs() > 1e-4  # far above the tolerance


@every_flat_body
def test_particles_that_slide_along_a_body_have_gradients_of_its_parameters(name):
    """They fall onto the body and stay in touch: contact reads the same field."""
    make, parameters, _ = BODIES[name]
    model, values = emulator(cells=32), leaves(parameters)
    particles = state(model, make(*values), count=3)
    above = torch.tensor([[[0.47, 0.52], [0.5, 0.53], [0.53, 0.54]]], dtype=torch.float64)
    fast = torch.tensor([0.004, -0.03], dtype=torch.float64).expand(1, 3, 2)
    path = differentiable_rollout(model, particles.with_motion(above, fast), FRAMES)
    free = differentiable_rollout(emulator(cells=32, solids=False), particles.with_motion(above, fast), FRAMES)
    assert (path[:, -1, :, 1] > free[:, -1, :, 1] + 0.02).all()
    slopes = torch.stack(torch.autograd.grad(path[:, -1].sum(), values))
    assert slopes.isfinite().all()
    assert slopes.abs().max() > 1e-4


@pytest.mark.parametrize(
    ("dim", "body", "message"),
    [
        (3, Disc((0.5, 0.5), 0.1), "this model's scenes have 3: Ramp, Disc and Polygon are for two"),
        (2, Sphere((0.5, 0.5, 0.5), 0.1), "this model's scenes have 2: Ramp"),
        (2, Disc((2.0, 2.0), 0.1), "Disc: no part of it is within the domain"),
    ],
    ids=["flat", "in space", "outside"],
)
def test_bodies_that_no_cell_would_see_are_refused(dim, body, message):
    scene = box(dim, obstacles=True)
    with pytest.raises(ConfigError, match=message):
        sample_bodies([[body]], scene, Grid.of(scene, 8))


@pytest.mark.parametrize(
    "body", [Ramp((0.5, 0.4), 0.3, 0.06, 0.4), Disc((0.02, 0.9), 0.2), Sphere((0.5, 0.4, 0.6), 0.2)]
)
def test_no_point_of_a_body_is_left_out(body):
    scene = box(body.dim, obstacles=True)
    grid = Grid.of(scene, 8)
    points = lattice(grid, SAMPLES)
    solid = solid_share(body.distance(points), BAND * min(grid.spacing)) > 0
    assert torch.equal(sample_bodies([[body]], scene, grid)[0], points[solid])


# ---- states


@pytest.mark.parametrize("name", ["position", "velocity", "gravity"])
def test_gradients_of_the_state_are_those_of_finite_differences(name):
    model = emulator(solids=False)
    particles = state(model, Ramp((0.5, 0.35), 0.3, 0.06, 0.4))
    assert torch.autograd.gradcheck(
        lambda values: loss(model, dataclasses.replace(particles, **{name: values})),
        getattr(particles, name).clone().requires_grad_(), eps=1e-7, atol=1e-3, rtol=1e-3, fast_mode=True,
    )  # fmt: skip


@pytest.mark.parametrize("constraints", [{}, {"density_cap": 0.5, "energy": True, "rest_speed": 0.01}])
def test_gradients_of_an_obstacle_alone_are_not_lost_to_the_kernels(constraints):
    """In float32, where rollouts without gradients take fused kernels."""
    model = emulator(**constraints).float()

    def derivative(also_of_the_position: bool) -> torch.Tensor:
        angle = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
        particles = with_obstacle(cloud(model.scene, 12), Ramp((0.5, 0.35), 0.3, 0.03, angle).particles(0.03))
        particles.position.requires_grad_(also_of_the_position)
        loss(model, dataclasses.replace(particles, gravity=torch.tensor([[0.0, -6e-5]]))).backward()
        return angle.grad

    alone = derivative(False)
    assert alone.abs() > 1e-6
    torch.testing.assert_close(alone, derivative(True), rtol=1e-4, atol=1e-6)


def test_states_are_checked():
    model = emulator()
    particles = state(model, Disc((0.5, 0.3), 0.1))
    with pytest.raises(ValueError, match="at least 1"):
        differentiable_rollout(model, particles, 0)
    with pytest.raises(DataError, match="outside of the domain"):
        differentiable_rollout(model, dataclasses.replace(particles, position=particles.position + 1), 2)
