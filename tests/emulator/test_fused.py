"""The kernels give what tensor operations give, to rounding, whatever the scene."""

import contextlib
import dataclasses
import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud

from nmpm.data.initial_states import lattice
from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.fused.call import KernelCall
from nmpm.emulator.prediction import FusedSteps, TensorSteps, steps_for
from nmpm.emulator.rollouts import rollout
from nmpm.particles import Particles
from nmpm.processors import Pointwise, UNet
from nmpm.transfer import Linear, Nearest, Quadratic, without_kernels

LIMIT = 2e-4  # cells: positions reach 16, and three bundles amplify their rounding


def emulator_of(scene, cells=12, frames=4, scale=1.0, seed=0, **parts) -> Emulator:
    torch.manual_seed(seed)
    emulator = EmulatorRecipe(scene, cells, frames, processor=Pointwise(hidden=(8,)), **parts).build().eval()
    emulator.output_scale.mul_(scale)
    return emulator


def scene_of(dim, walls, materials, obstacles=False, gravity=True, slim=False):
    names = ("water", "sand", "goop")[:materials]
    boundary = tuple("wall" if wall else "periodic" for wall in walls[:dim])
    domain = tuple((0.08, 0.92) if wall else (0.1, 0.9) for wall in walls[:dim])
    scene = box(
        dim, names, boundary=boundary, domain=domain, obstacles=obstacles, densities=(1.0, 2.0, 3.0)[:materials]
    )
    if slim:  # cells that are not square
        stretched = ((0.1, 1.3), *scene.bounds[1:])
        scene = dataclasses.replace(scene, bounds=stretched, domain=((0.05, 1.35), *scene.domain[1:]))
    return scene if gravity else dataclasses.replace(scene, gravity=None)


def predict_both(emulator, particles):
    """A bundle's positions in cells, by kernels and by tensor operations."""
    with torch.no_grad():
        assert isinstance(steps_for(emulator, particles, emulator.solid(particles)), FusedSteps)
        fused = emulator(particles)
        with without_kernels():
            assert isinstance(steps_for(emulator, particles, emulator.solid(particles)), TensorSteps)
            tensors = emulator(particles)
    spacing = torch.tensor(emulator.grid.spacing)
    return [torch.stack([b.position[:, -1], b.velocity]) / spacing for b in (fused, tensors)]


@given(
    dim=st.integers(2, 3),
    walls=st.lists(st.booleans(), min_size=3, max_size=3),
    materials=st.integers(1, 3),
    transfer=st.sampled_from([Nearest(), Linear(), Quadratic()]),
    decoder=st.sampled_from([Absolute(), Residual(), Flip(), Blend(0.8), Acceleration()]),
    bounds=st.sampled_from(["stop", "reflect"]),
    energy=st.booleans(),
    cap=st.sampled_from([0.0, 0.3, 2.0]),
    rest=st.sampled_from([0.0, 0.05]),
    speed=st.sampled_from([0.0, 0.002, 0.05]),
    scale=st.sampled_from([0.1, 1.0, 5.0]),
    count=st.sampled_from([0, 1, 17, 700]),
    batch=st.integers(1, 2),
    slim=st.booleans(),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_a_bundle_is_that_of_tensor_operations(
    dim, walls, materials, transfer, decoder, bounds, energy, cap, rest, speed, scale, count, batch, slim, seed
):
    scene = scene_of(dim, walls, materials, slim=slim and walls[0])
    constraints = Constraints(energy=energy, rest_speed=rest, bounds=bounds, density_cap=cap)
    emulator = emulator_of(scene, scale=scale, seed=seed, transfer=transfer, decoder=decoder, constraints=constraints)
    particles = cloud(scene, count, batch, speed, seed)
    if batch > 1 and count:
        particles.mask[1, count // 2 :] = False
    fused, tensors = predict_both(emulator, particles)
    # A particle whose decision hangs on rounding (at rest or not, shortened or not) may differ: almost none may.
    different = ((fused - tensors).abs() > LIMIT).any(-1).any(0)
    assert different.float().mean() <= 0.02 if count > 1 else not different.any() or rest or energy


@given(
    seed=st.integers(0, 1000),
    dim=st.integers(2, 3),
    speed=st.sampled_from([0.002, 0.03, 0.3]),
    many=st.booleans(),
    cap=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_contact_is_that_of_tensor_operations(seed, dim, speed, many, cap):
    scene = scene_of(dim, [True] * 3, 1, obstacles=True)
    constraints = Constraints(energy=many, rest_speed=0.01 * many, density_cap=0.3 * cap)
    emulator = emulator_of(scene, seed=seed, constraints=constraints)
    fused, tensors = predict_both(emulator, cloud(scene, 300, 2, speed, seed, statics=30 if many else 5))
    different = ((fused - tensors).abs() > LIMIT).any(-1).any(0)
    assert different.float().mean() <= 0.02


@given(
    seed=st.integers(0, 1000),
    walls=st.lists(st.booleans(), min_size=3, max_size=3),
    dim=st.integers(2, 3),
    obstacles=st.booleans(),
    width=st.sampled_from([0.02, 0.15]),
)
@settings(max_examples=20, deadline=None)
def test_crowds_spread_as_with_tensor_operations(seed, walls, dim, obstacles, width):
    scene = scene_of(dim, walls, 2, obstacles=obstacles, slim=walls[0])
    emulator = emulator_of(scene, scale=0.01, seed=seed, constraints=Constraints(density_cap=0.8 if dim == 2 else 0.02))
    particles = cloud(scene, 600, 2, 0.0, seed, statics=5 if obstacles else 0)
    middle = torch.tensor([sum(ends) / 2 for ends in scene.bounds])
    particles.position[0] = middle + width * (particles.position[0] - middle)
    particles.mask[0, 500:] = False
    fused, tensors = predict_both(emulator, particles)
    moved = fused[0] - predict_both(emulator.unconstrained(), particles)[0][0]
    assert moved[0, :500].abs().max() > 10 * LIMIT
    different = ((fused - tensors).abs() > LIMIT).any(-1).any(0)
    assert different.float().mean() <= 0.002


@given(seed=st.integers(0, 1000), dim=st.integers(2, 3), wall=st.booleans(), speed=st.sampled_from([0.01, 0.1, 3.0]))
@settings(max_examples=20, deadline=None)
def test_particles_far_from_obstacles_need_no_contact_to_the_bit(seed, dim, wall, speed):
    scene = scene_of(dim, [wall] * 3, 1, obstacles=True)
    emulator, particles = emulator_of(scene, seed=seed), cloud(scene, 300, 2, speed, seed, statics=3)
    with torch.no_grad():
        context = emulator.context(particles)
        unprepared = dataclasses.replace(context, solid_caches=None)
        assert context.solid_caches[0].clearance.max() > 1
        assert torch.equal(emulator(particles, context).position, emulator(particles, unprepared).position)


def test_rollouts_are_those_of_tensor_operations():
    scene = box()
    torch.manual_seed(0)
    network = UNet(width=4, depth=1, perceptron=(4,))
    emulator = EmulatorRecipe(scene, 16, 4, processor=network, constraints=Constraints(energy=True)).build().eval()
    particles = cloud(scene, 200)
    with without_kernels():
        tensors = rollout(emulator, particles, 12)
    difference = (rollout(emulator, particles, 12) - tensors).abs().max() / emulator.grid.spacing[0]
    assert difference < LIMIT


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["position", "velocity"])
@pytest.mark.parametrize("walls", [[True, True], [False, True]])
def test_non_finite_inputs_stay_visible(bad, name, walls):
    scene = scene_of(2, walls, 1)
    emulator, particles = emulator_of(scene), cloud(scene, 50)
    getattr(particles, name)[0, 3, 0] = bad
    fused, tensors = predict_both(emulator, particles)
    assert torch.equal(fused.isfinite().all(-1)[0, 0, 3], tensors.isfinite().all(-1)[0, 0, 3])
    if name == "position" and not all(walls):
        return  # a NaN as an index of a periodic axis is any node
    far = torch.ones(50, dtype=torch.bool)
    far[3] = False
    torch.testing.assert_close(fused[:, 0, far], tensors[:, 0, far], rtol=1e-3, atol=LIMIT, equal_nan=True)


def test_padding_changes_nothing_to_the_bit_not_even_if_it_is_not_a_number():
    scene = box(materials=("water", "sand"))
    constraints = Constraints(energy=True, rest_speed=0.01)
    emulator, particles = emulator_of(scene, constraints=constraints), cloud(scene, 40)
    padded = cloud(scene, 60)
    for name in ("position", "velocity", "material"):
        getattr(padded, name)[:, :40] = getattr(particles, name)
    padded.mask[:, 40:] = False
    padded.velocity[:, 50:] = 1e3
    with torch.no_grad():
        assert torch.equal(emulator(padded).position[:, :, :40], emulator(particles).position)


@pytest.mark.parametrize("backend", [None, "native"])
@pytest.mark.parametrize("seed", range(3))
def test_padding_changes_nothing_beside_obstacles_however_fast_and_wherever_it_is(backend, seed):
    scene = box(obstacles=True)
    slab = lattice(((0.3, 0.7), (0.35, 0.5)), 0.02)[None]
    obstacle = {"obstacle": slab, "obstacle_mask": torch.ones(slab.shape[:2], dtype=torch.bool)}
    emulator = emulator_of(scene, cells=16, seed=seed, decoder=Flip())
    particles = dataclasses.replace(cloud(scene, 200, speed=0.02, seed=seed), **obstacle)
    padded = dataclasses.replace(cloud(scene, 260, seed=seed), **obstacle)
    for name in ("position", "velocity", "material"):
        getattr(padded, name)[:, :200] = getattr(particles, name)
    padded.mask[:, 200:] = False
    padded.position[:, 200:230] = slab[:, :30]
    padded.velocity[:, 230:] = 0.4
    with torch.no_grad(), without_kernels() if backend else contextlib.nullcontext():
        assert torch.equal(emulator(padded).position[:, :, :200], emulator(particles).position)


def test_the_number_of_threads_changes_nothing_to_the_bit(monkeypatch):
    scene = box(obstacles=True)
    for name in ("call.CHUNK", "contact.CHUNK", "path.CHUNK", "rest.CHUNK", "state._CHUNK"):
        monkeypatch.setattr(f"nmpm.emulator.fused.{name}", 256)
    emulator = emulator_of(scene, constraints=Constraints(energy=True, rest_speed=0.01)).requires_grad_(False)
    particles, threads, positions = cloud(scene, 3000, 2, statics=20), torch.get_num_threads(), []
    call = KernelCall(emulator, emulator.kernel_parameters, emulator.context(particles))
    output = torch.randn(2, emulator.frames, 2, *emulator.grid.shape)
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            start = call.rasterise(particles)
            positions.append(call.finish(start, call.path(start, output)).position)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*positions)


def test_a_rollout_goes_on_from_its_middle_to_the_bit():
    scene = box()
    emulator, particles = emulator_of(scene, constraints=Constraints(rest_speed=0.01)), cloud(scene, 60)
    with torch.no_grad():
        first = emulator(particles)
        middle = particles.with_motion(first.position[:, -1].clone(), first.velocity.clone())
        assert torch.equal(rollout(emulator, particles, 8)[:, 4:], emulator(middle).position)


def test_scenes_of_a_batch_are_as_alone_to_the_bit():
    scene = box(materials=("water", "sand"), obstacles=True)
    emulator = emulator_of(scene, constraints=Constraints(energy=True, rest_speed=0.01))
    particles = cloud(scene, 80, 3, 0.02, statics=10)
    together = rollout(emulator, particles, 8)
    for index in range(3):
        alone = rollout(emulator, particles.scenes(slice(index, index + 1)), 8)
        torch.testing.assert_close(together[index : index + 1], alone, rtol=0, atol=1e-6)


def test_a_material_that_does_not_exist_is_an_error_not_a_crash():
    scene = box(materials=("water", "sand"))
    particles = cloud(scene, 10)
    particles.material[0, 0] = 7
    with torch.no_grad(), pytest.raises(IndexError, match="material"):
        emulator_of(scene)(particles)


def test_gradients_and_everything_else_take_tensor_operations():
    scene = box()
    emulator, particles = emulator_of(scene), cloud(scene, 10)

    def fused(model=emulator, state=particles):
        return isinstance(steps_for(model, state, model.solid(state)), FusedSteps)

    assert not fused()  # the weights want gradients
    with torch.no_grad():
        assert fused()
        assert not fused(state=particles.double())
        assert not fused(emulator_of(scene, constraints=Constraints(bounds="error")))
        assert not fused(emulator_of(scene, transfer=type("Own", (Linear,), {})()))
        assert not fused(emulator_of(scene).train())
        assert not fused(emulator_of(scene).double())
    frozen = emulator_of(scene).requires_grad_(False)
    assert fused(frozen)
    assert not fused(frozen, dataclasses.replace(particles, velocity=particles.velocity.requires_grad_()))


def test_traced_graphs_take_tensor_operations():
    scene = box()
    emulator, particles = emulator_of(scene, constraints=Constraints(energy=True)), cloud(scene, 30)

    def call(position, velocity):
        return emulator(particles.with_motion(position, velocity)).position

    with torch.no_grad():
        traced = torch.compile(call, backend="eager")(particles.position, particles.velocity)
        torch.testing.assert_close(traced, emulator(particles).position, rtol=0, atol=1e-6)


def test_importing_nmpm_and_loading_a_model_do_not_import_numba():
    code = "import sys; from nmpm.zoo import Zoo; Zoo.load('goop'); assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_particles_are_a_state_again():
    scene = box()
    emulator, particles = emulator_of(scene), cloud(scene, 10)
    with torch.inference_mode():
        bundle = emulator(particles)
        state: Particles = particles.with_motion(bundle.position[:, -1], bundle.velocity)
        assert emulator(state).position.isfinite().all()
    assert bundle.position.dtype == bundle.velocity.dtype == torch.float32
