"""The kernels give what tensor operations give, to rounding: rollouts, and in training values and gradients."""

import dataclasses
import subprocess
import sys
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator.engines import find_engine
from nmpm.emulator.engines.numba.engine import NumbaEngine
from nmpm.emulator.rollouts import Rollout, rollout
from nmpm.particles import lattice
from nmpm.training.losses import PositionLoss
from nmpm.transfer import Linear, Nearest, Quadratic, without_kernels
from nmpm.zoo import Zoo
from tests.scenes import box, cloud, emulator_of, padded, window_of, with_obstacle

LIMIT = 2e-4  # cells: positions reach 16
DECODERS = [Absolute(), Residual(), Flip(), Blend(0.8), Acceleration()]
HELD = {"energy": True, "rest_speed": 0.01}


def scene_of(dim, walls, materials=1, obstacles=False, slim=False):
    names, boundary = ("water", "sand", "goop")[:materials], tuple("wall" if wall else "periodic" for wall in walls)
    domain = tuple((0.08, 0.92) if wall else (0.1, 0.9) for wall in walls[:dim])
    densities = (1.0, 2.0, 3.0)[:materials]
    scene = box(dim, names, boundary=boundary[:dim], domain=domain, obstacles=obstacles, densities=densities)
    if slim and walls[0]:  # cells that are not square
        bounds, domain = ((0.1, 1.3), *scene.bounds[1:]), ((0.05, 1.35), *scene.domain[1:])
        return dataclasses.replace(scene, bounds=bounds, domain=domain)
    return scene


FIELDS = {"evolving": ("temperature", "salt"), "properties": ("stiffness",), "parameters": ("friction",)}


def with_extras(scene, particles, fields=False, moving=False, sizes=False):
    """The scene and the state with fields of particles and scenes, obstacles that move, or several sizes."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.rand(*shape, generator=generator)

    batch, count = particles.mask.shape
    if fields:
        scene = dataclasses.replace(scene, **FIELDS)
        given = {"temperature": random(batch, count), "stiffness": random(batch, count), "friction": random(batch, 1)}
        particles = particles.with_fields(given)  # without salt
    if moving:
        scene, speeds = dataclasses.replace(scene, moving_obstacles=True), random(*particles.obstacle.shape)
        particles = dataclasses.replace(particles, obstacle_velocity=0.02 * (speeds - 0.5))
    if sizes:
        particles = dataclasses.replace(particles, volume=0.5 + random(batch, count))
    return scene, particles


def engine_of(emulator, particles):
    return find_engine(emulator, particles, emulator.solid(particles)).name


def predict_both(emulator, particles):
    """A bundle's last positions and velocities in cells, and fields, by kernels and by tensor operations."""
    with torch.no_grad():
        assert engine_of(emulator, particles) == "numba"
        fused = emulator(particles)
        with without_kernels():
            assert engine_of(emulator, particles) == "torch"
            tensors = emulator(particles)
    spacing = torch.tensor(emulator.grid.spacing)
    assert fused.fields.keys() == tensors.fields.keys()
    return [
        torch.cat([torch.stack([bundle.position[:, -1], bundle.velocity]) / spacing, *_last_fields(bundle)], dim=-1)
        for bundle in (fused, tensors)
    ]


def _last_fields(bundle):
    return [values[:, -1, :, None].expand(2, -1, -1, -1) for values in bundle.fields.values()]


def share_that_differs(emulator, particles) -> float:
    """Share of the particles; one whose decision hangs on rounding (at rest or not, shortened or not) may differ."""
    fused, tensors = predict_both(emulator, particles)
    differs = ((fused - tensors).abs() > LIMIT).any(-1).any(0)
    return differs[particles.mask].float().mean().nan_to_num().item()


# ---- rollouts


@pytest.mark.parametrize("name", Zoo.list())
def test_shipped_models_with_their_constraints(name):
    emulator = Zoo.load(name).emulator
    scene, flat = emulator.scene, emulator.scene.dim == 2
    low, high = torch.tensor(scene.bounds).T
    particles = cloud(scene, 500, speed=2e-3, statics=20 * scene.obstacles)
    place = low + (high - low) * (0.05 + 0.5 * (particles.position - 0.3) / 0.4)
    obstacle = low + (high - low) * (particles.obstacle - 0.2) / 0.6
    particles = dataclasses.replace(particles, position=place, obstacle=obstacle)
    assert share_that_differs(emulator, particles) <= (0.01 if flat else 0.02)


def case(dim, walls, transfer, decoder, bounds="stop", materials=1, obstacles=False, slim=False, extras=(), **held):
    parts = {"transfer": transfer, "decoder": decoder, "bounds": bounds} | held
    return scene_of(dim, walls, materials, obstacles, slim), extras, parts


CASES = {
    "free": case(2, (True, True), Linear(), Residual()),
    "energy": case(2, (True, True), Linear(), Flip(), energy=True),
    "at rest, reflected": case(2, (True, True), Nearest(), Blend(0.8), "reflect", 2, rest_speed=0.05),
    "crowded": case(2, (False, True), Linear(), Absolute(), materials=3, energy=True, density_cap=0.3),
    "slim cells": case(2, (True, True), Quadratic(), Acceleration(), slim=True, density_cap=0.3, **HELD),
    "obstacles": case(2, (True, True), Linear(), Residual(), obstacles=True, density_cap=0.3, **HELD),
    "fields": case(2, (True, True), Linear(), Residual(), materials=2, extras=("fields",), **HELD),
    "fields and sizes": case(
        2, (False, True), Nearest(), Blend(0.8), extras=("fields", "sizes"), density_cap=0.3, **HELD
    ),
    "moving obstacles": case(
        2, (True, True), Linear(), Flip(), obstacles=True, extras=("moving", "sizes"), density_cap=0.3, **HELD
    ),
    "3-D": case(3, (True, True, False), Linear(), Flip(), "reflect", 2, energy=True, density_cap=0.3),
    "3-D, fields": case(3, (True, True, False), Quadratic(), Flip(), materials=2, extras=("fields", "sizes")),
    "3-D, quadratic": case(3, (False, True, True), Quadratic(), Acceleration(), rest_speed=0.05),
    "3-D, obstacles": case(3, (True, True, True), Linear(), Residual(), obstacles=True, density_cap=0.3, **HELD),
}


@pytest.mark.parametrize("name", CASES)
def test_bundles(name):
    scene, extras, parts = CASES[name]
    particles = cloud(scene, 400, 2, 0.02, statics=20 * scene.obstacles)
    scene, particles = with_extras(scene, particles, **dict.fromkeys(extras, True))
    particles.mask[1, 200:] = False
    assert share_that_differs(emulator_of(scene, cells=12, **parts), particles) <= 0.02


@pytest.mark.slow
@given(
    dim=st.integers(2, 3), walls=st.lists(st.booleans(), min_size=3, max_size=3), materials=st.integers(1, 3),
    transfer=st.sampled_from([Nearest(), Linear(), Quadratic()]), decoder=st.sampled_from(DECODERS),
    bounds=st.sampled_from(["stop", "reflect"]), energy=st.booleans(), cap=st.sampled_from([0.0, 0.3, 2.0]),
    rest=st.sampled_from([0.0, 0.05]), speed=st.sampled_from([0.0, 0.002, 0.05, 0.3]),
    scale=st.sampled_from([0.1, 1.0, 5.0]), count=st.sampled_from([0, 1, 17, 700]), batch=st.integers(1, 2),
    slim=st.booleans(), statics=st.sampled_from([0, 5, 30]), seed=st.integers(0, 1000), fields=st.booleans(),
    moving=st.booleans(), sizes=st.booleans(),
)  # fmt: skip
@settings(max_examples=80)
def test_bundles_of_any_kind(
    dim, walls, materials, transfer, decoder, bounds, energy, cap, rest, speed, scale, count, batch, slim, statics,
    seed, fields, moving, sizes,
):  # fmt: skip
    walls, obstacles = [True] * 3 if statics else walls, statics > 0
    held = {"energy": energy, "rest_speed": rest, "density_cap": cap}
    scene, _, parts = case(dim, walls, transfer, decoder, bounds, materials, obstacles, slim and not obstacles, **held)
    particles = cloud(scene, count, batch, speed, seed, statics)
    scene, particles = with_extras(scene, particles, fields, moving and obstacles, sizes)
    if batch > 1 and count:
        particles.mask[1, count // 2 :] = False
    share = share_that_differs(emulator_of(scene, cells=12, scale=scale, seed=seed, **parts), particles)
    assert share <= 0.02 if count > 1 else share == 0 or rest or energy


def test_single_frames_and_bfloat16():
    emulator = emulator_of(box(), cells=12, frames=1, rest_speed=0.01).with_network(torch.bfloat16)
    assert share_that_differs(emulator, cloud(box(), 60)) == 0


@pytest.mark.parametrize(
    ("name", "bad", "walls"),
    [
        ("position", float("nan"), [True, True]),
        ("position", float("inf"), [False, True]),
        ("velocity", float("nan"), [False, True]),
        ("velocity", float("inf"), [True, True]),
    ],
)
def test_non_finite_inputs_stay_visible(name, bad, walls):
    scene = scene_of(2, walls)
    emulator, particles = emulator_of(scene, cells=12), cloud(scene, 50)
    getattr(particles, name)[0, 3, 0] = bad
    fused, tensors = predict_both(emulator, particles)
    assert torch.equal(fused.isfinite().all(-1)[0, 0, 3], tensors.isfinite().all(-1)[0, 0, 3])
    if name == "velocity" or all(walls):  # a NaN as an index of a periodic axis is any node
        far = torch.arange(50) != 3
        torch.testing.assert_close(fused[:, 0, far], tensors[:, 0, far], rtol=1e-3, atol=LIMIT, equal_nan=True)


def test_a_field_that_is_not_finite_spreads_as_far():
    scene, particles = with_extras(box(), cloud(box(), 50), fields=True)
    particles.fields["temperature"][0, 3] = float("nan")
    fused, tensors = predict_both(emulator_of(scene, cells=12), particles)
    assert not fused[:, 0, 3].isfinite().all()
    torch.testing.assert_close(fused, tensors, rtol=1e-3, atol=LIMIT, equal_nan=True)


FILLERS = [float("nan"), float("inf"), -float("inf"), 3e38, -1e30, 0.0, 0.5]
CONSTRAINED = [{}, HELD, {**HELD, "density_cap": 1.0}, {"bounds": "reflect", "energy": True}]


@pytest.mark.parametrize("constraints", CONSTRAINED, ids=str)
@pytest.mark.parametrize("kernels", [True, False], ids=["kernels", "tensors"])
@given(filler=st.sampled_from(FILLERS), number=st.integers(-9, 9), of=st.sampled_from(["position", "velocity", "all"]))
@settings(max_examples=8, deadline=None)
def test_a_rollout_is_the_same_to_the_bit_whatever_padding_holds(kernels, constraints, filler, number, of):
    scene, particles = with_extras(box(obstacles=True), cloud(box(), 60, batch=2, statics=9), True, True, True)
    emulator = emulator_of(scene, cells=12, scale=2.0, **constraints)
    particles = dataclasses.replace(particles, mask=torch.arange(60).expand(2, 60) < torch.tensor([[60], [47]]))
    particles = dataclasses.replace(particles, obstacle_mask=torch.arange(9).expand(2, 9) < torch.tensor([[4], [9]]))
    real, solid = particles.mask, particles.obstacle_mask
    changed = {of: getattr(particles, of).masked_fill(~real.unsqueeze(-1), filler)} if of != "all" else {
        name: getattr(particles, name).masked_fill(~there, filler)
        for name, there in {
            "position": real.unsqueeze(-1), "velocity": real.unsqueeze(-1), "volume": real,
            "obstacle": solid.unsqueeze(-1), "obstacle_velocity": solid.unsqueeze(-1),
        }.items()
    } | {"material": particles.material.masked_fill(~real, number)}  # fmt: skip
    dirty = dataclasses.replace(particles, **changed)
    filled = {n: v if v.shape[1] == 1 else v.masked_fill(~real, filler) for n, v in dirty.fields.items()}
    dirty = dirty.with_fields(filled) if of == "all" else dirty
    with nullcontext() if kernels else without_kernels():
        one, other = (rollout(emulator, state, 2 * emulator.frames) for state in (particles, dirty))
    there = real[:, None, :, None]
    assert torch.equal(one.where(there, 0.0), other.where(there, 0.0))
    assert other.isfinite().all()


@pytest.mark.parametrize("transfer", [Nearest(), Linear(), Quadratic()])
@pytest.mark.parametrize("kernels", [True, False], ids=["kernels", "tensors"])
def test_padding_changes_nothing_to_the_bit_however_fast_and_wherever_it_is(kernels, transfer):
    scene, slab = box(obstacles=True), lattice(((0.3, 0.7), (0.35, 0.5)), 0.02)
    emulator = emulator_of(scene, transfer=transfer, decoder=Flip(), **HELD if kernels else {})
    particles = with_obstacle(cloud(scene, 200, speed=0.02), slab)
    anywhere = torch.cat([slab[:30], cloud(scene, 30, seed=1).position[0]])
    with torch.no_grad(), nullcontext() if kernels else without_kernels():
        one, other = (emulator(state).position for state in (particles, padded(particles, anywhere, velocity=0.4)))
    assert torch.equal(other[:, :, :200], one)
    assert other.isfinite().all()


def with_threads(numbers, action):
    threads = torch.get_num_threads()
    try:
        for number in numbers:
            torch.set_num_threads(number)
            yield action()
    finally:
        torch.set_num_threads(threads)


def test_the_number_of_threads_changes_nothing_to_the_bit(monkeypatch):
    scene = box(obstacles=True)
    for name in ("engine.CHUNK", "contact.CHUNK", "path.CHUNK", "rest.CHUNK", "state._CHUNK"):
        monkeypatch.setattr(f"nmpm.emulator.engines.numba.{name}", 256)
    emulator = emulator_of(scene, cells=12, **HELD).requires_grad_(False)
    particles = cloud(scene, 3000, 2, statics=20)
    engine, context = NumbaEngine(emulator), emulator.context(particles)
    output = torch.randn(2, emulator.frames, 2, *emulator.grid.shape)

    def move():
        start = engine.rasterise(particles, context)
        return engine.land(start, engine.spread(start, engine.fly(start, output, context), context)).position

    assert torch.equal(*with_threads((1, 3), move))


def test_rollouts_go_on_from_the_middle_to_the_bit_and_scenes_are_as_alone():
    scene = box(materials=("water", "sand"), obstacles=True)
    emulator, particles = emulator_of(scene, cells=12, **HELD), cloud(scene, 80, 2, 0.02, statics=10)
    together = rollout(emulator, particles, 8)
    with torch.no_grad():
        first = emulator(particles, emulator.context(particles))
        middle = particles.with_motion(first.position[:, -1].clone(), first.velocity.clone())
        after = emulator(middle, emulator.context(particles)).position
    assert torch.equal(together[:, 4:], after)
    for index in range(2):
        alone = rollout(emulator, particles.scenes(slice(index, index + 1)), 8)
        torch.testing.assert_close(together[index : index + 1], alone, rtol=0, atol=1e-6)


def test_a_material_that_does_not_exist_is_an_error_not_a_crash():
    scene = box(materials=("water", "sand"))
    particles = cloud(scene, 10)
    particles.material[0, 0] = 7
    with torch.no_grad(), pytest.raises(IndexError, match="material"):
        emulator_of(scene, cells=12)(particles)


@pytest.mark.parametrize("change", ["statistics", "gravity", "mask"])
def test_a_rollouts_context_follows_what_changes(change):
    scene = box(obstacles=True)
    emulator, particles = emulator_of(scene, cells=12, energy=True), cloud(scene, 60, statics=5)
    emulator.requires_grad_(False)
    context = emulator.context(particles)
    before = emulator(particles, context).position
    if change == "statistics":
        emulator.output_scale.mul_(3)
    elif change == "gravity":
        particles = dataclasses.replace(particles, gravity=-particles.gravity)
    else:
        particles.mask[:, 40:] = False
    unprepared = dataclasses.replace(context, prepared=None)
    assert not torch.equal(emulator(particles, context).position, before)
    assert torch.equal(emulator(particles, context).position, emulator(particles, unprepared).position)


# ---- which calls the kernels take


def test_what_has_no_kernels_takes_tensor_operations():
    scene, space, particles = box(), box(3), cloud(box(), 10)
    unknown = emulator_of(scene, transfer=type("Own", (Linear,), {})())
    assert engine_of(emulator_of(scene), particles) == "torch"  # the weights want gradients
    assert engine_of(emulator_of(scene).train(), particles) == "numba training"
    for parts in ({"transfer": Quadratic()}, {"bounds": "reflect"}):
        assert engine_of(emulator_of(scene, **parts).train(), particles) == "torch"
    assert engine_of(emulator_of(space, cells=8).train(), cloud(space)) == "torch"
    with torch.no_grad():
        assert engine_of(emulator_of(scene), particles) == "numba"
        assert engine_of(emulator_of(scene), particles.double()) == "torch"
        for other in (unknown, emulator_of(scene, bounds="error"), unknown.double()):
            assert engine_of(other, particles) == "torch"
    moving = dataclasses.replace(particles, velocity=particles.velocity.requires_grad_())
    assert engine_of(emulator_of(scene).requires_grad_(False), moving) == "torch"


@pytest.mark.slow
def test_traced_graphs_take_tensor_operations():
    emulator, particles = emulator_of(box(), energy=True), cloud(box(), 30)

    def call(position, velocity):
        return emulator(particles.with_motion(position, velocity)).position

    with torch.no_grad():
        traced = torch.compile(call, backend="eager")(particles.position, particles.velocity)
        torch.testing.assert_close(traced, emulator(particles).position, rtol=0, atol=1e-6)


def test_importing_nmpm_and_loading_a_model_do_not_import_numba():
    code = "import sys; from nmpm.zoo import Zoo; Zoo.load('goop'); assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


# ---- training


def trained(scene, seed=0, **parts):
    return emulator_of(scene, cells=10, frames=3, seed=seed, **parts).train()


def train_once(emulator, particles):
    """Loss, predicted positions, and gradients with respect to the state and all weights, over two bundles."""
    torch.manual_seed(1)
    position, velocity = (values.clone().requires_grad_() for values in (particles.position, particles.velocity))
    fields = {name: values.clone().requires_grad_(values.shape[1] > 1) for name, values in particles.fields.items()}
    state, paths = particles.with_motion(position, velocity).with_fields(fields), []
    for _ in range(2):
        bundle = emulator(state)
        state = bundle.state_after(state)
        paths.append(bundle.position)
    predicted = torch.cat(paths, dim=1)
    shift = 0.01 * torch.arange(-1, predicted.shape[1] + 1).clamp(min=0).view(1, -1, 1, 1)
    window = window_of(dataclasses.replace(particles, fields={}), particles.position.unsqueeze(1) + shift)
    loss = PositionLoss(0.5, 4.0)(Rollout(predicted, {}), window, emulator)
    real = particles.mask.unsqueeze(1)
    loss = loss + sum((values * real).square().mean() for values in bundle.fields.values())
    leaves = [position, velocity, *(values for values in fields.values() if values.requires_grad)]
    gradients = torch.autograd.grad(loss, [*leaves, *emulator.parameters()], allow_unused=True)
    return loss, predicted, [torch.zeros(()) if each is None else each for each in gradients]


def check_training(walls, materials, decoder, obstacles, count, seed=0, speed=0.005, sizes=None, extras=False):
    scene = scene_of(2, walls, materials, obstacles)
    particles = cloud(scene, count, 2, speed, seed, 5 * obstacles)
    scene, particles = with_extras(scene, particles, extras, extras and obstacles)
    emulator = trained(scene, seed, decoder=decoder)
    particles.mask[1, (count + 1) // 2 :] = False
    if sizes is not None:
        volume = torch.where(particles.mask, torch.tensor(sizes).unsqueeze(1), 1.0)
        particles = dataclasses.replace(particles, volume=volume)
    assert engine_of(emulator, particles) == "numba training"
    loss, predicted, gradients = train_once(emulator, particles)
    with without_kernels():
        assert engine_of(emulator, particles) == "torch"
        tensors = train_once(emulator, particles)
    torch.testing.assert_close(loss, tensors[0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(predicted, tensors[1], rtol=0, atol=1e-5)
    for gradient, other in zip(gradients, tensors[2], strict=True):
        # Where a node has almost no particle, gradients of its mean velocity are large differences, in either form.
        assert (gradient - other).norm() <= 5e-3 * other.norm() + 1e-6


@pytest.mark.parametrize(
    ("walls", "materials", "decoder", "obstacles", "speed"),
    [
        ((True, True), 1, Residual(), True, 0.005),
        ((False, True), 2, Blend(0.8), False, 0.005),
        ((True, False), 3, Acceleration(), False, 0.005),
        ((True, True), 1, Flip(), False, 0.2),  # walls stop particles, which pass no gradient on
    ],
)
def test_training_has_the_same_values_and_gradients(walls, materials, decoder, obstacles, speed):
    check_training(walls, materials, decoder, obstacles, 200, speed=speed)


@pytest.mark.parametrize(("materials", "obstacles"), [(2, False), (1, True)])
def test_fields_and_moving_obstacles_have_gradients_in_training(materials, obstacles):
    check_training((True, True), materials, Residual(), obstacles, 200, extras=True)


def test_scenes_may_have_particles_of_a_size_of_their_own_in_training():
    check_training((True, True), 2, Residual(), True, 100, sizes=(0.4, 2.5))
    several = dataclasses.replace(cloud(box(), 10), volume=torch.linspace(1.0, 2.0, 10).expand(1, -1))
    assert engine_of(emulator_of(box()).train(), several) == "torch"


@pytest.mark.slow
@given(
    walls=st.tuples(st.booleans(), st.booleans()), materials=st.integers(1, 3), decoder=st.sampled_from(DECODERS),
    obstacles=st.booleans(), count=st.sampled_from([1, 17, 300]), seed=st.integers(0, 1000), extras=st.booleans(),
)  # fmt: skip
@settings(max_examples=20)
def test_trainings_of_any_kind(walls, materials, decoder, obstacles, count, seed, extras):
    check_training(walls, materials, decoder, obstacles, count, seed, extras=extras)


def test_padding_gets_no_gradient_and_changes_none():
    scene = box(materials=("water", "sand"))
    emulator, particles = trained(scene), cloud(scene, 40)
    alone = train_once(emulator, particles)[2]
    together = train_once(emulator, padded(particles, cloud(scene, 20, seed=1).position[0]))[2]
    for gradient, other in zip(alone[:2], together[:2], strict=True):
        assert torch.equal(gradient, other[:, :40])
        assert not other[:, 40:].any()
    assert all(map(torch.equal, alone[2:], together[2:]))


def test_a_training_step_repeats_and_threads_change_nothing_to_the_bit():
    scene = box(materials=("water", "sand"))
    emulator, particles = trained(scene), cloud(scene, 300, 3)
    first, second = (train_once(emulator, particles) for _ in range(2))
    assert torch.equal(first[0], second[0])
    assert all(map(torch.equal, first[2], second[2]))
    engine = find_engine(emulator, particles, emulator.solid(particles))
    assert torch.equal(*with_threads((1, 3), lambda: engine.grid_state(particles, emulator.solid(particles))[3]))


@pytest.mark.parametrize("name", ["obstacle", "gravity"])
def test_gradients_of_obstacles_and_gravity_take_tensor_operations(name):
    scene = box(obstacles=True, gravity=None)
    emulator, particles = trained(scene), cloud(scene, 30, statics=10)
    leaf = getattr(particles, name).clone().requires_grad_()
    particles = dataclasses.replace(particles, **{name: leaf})
    assert engine_of(emulator, particles) == "torch"
    emulator(particles).position.square().sum().backward()
    assert leaf.grad.abs().sum() > 0


def test_second_derivatives_are_an_error():
    emulator, particles = trained(box()), cloud(box(), 10)
    position = particles.position.clone().requires_grad_()
    bundle = emulator(particles.with_motion(position, particles.velocity))
    (gradient,) = torch.autograd.grad(bundle.position.square().sum(), position, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
