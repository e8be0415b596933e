"""The kernels give what tensor operations give, to rounding: rollouts, and in training values and gradients."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud

from nmpm.data.initial_states import lattice
from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.fused.arrays import ArrayCache, as_grid
from nmpm.emulator.fused.call import KernelCall
from nmpm.emulator.fused.state import output_arrays
from nmpm.emulator.prediction import FusedSteps, TensorSteps, TrainingSteps, steps_for
from nmpm.emulator.rollouts import rollout
from nmpm.processors import Pointwise
from nmpm.transfer import Linear, Nearest, Quadratic, without_kernels
from nmpm.zoo import Zoo

LIMIT = 2e-4  # cells: positions reach 16
DECODERS = [Absolute(), Residual(), Flip(), Blend(0.8), Acceleration()]
HELD = {"energy": True, "rest_speed": 0.01}


def emulator_of(scene, cells=12, frames=4, scale=1.0, seed=0, **parts) -> Emulator:
    torch.manual_seed(seed)
    emulator = EmulatorRecipe(scene, cells, frames, processor=Pointwise(hidden=(8,)), **parts).build().eval()
    emulator.output_scale.mul_(scale)
    return emulator


def scene_of(dim, walls, materials=1, obstacles=False, slim=False):
    names, boundary = ("water", "sand", "goop")[:materials], tuple("wall" if wall else "periodic" for wall in walls)
    domain = tuple((0.08, 0.92) if wall else (0.1, 0.9) for wall in walls[:dim])
    densities = (1.0, 2.0, 3.0)[:materials]
    scene = box(dim, names, boundary=boundary[:dim], domain=domain, obstacles=obstacles, densities=densities)
    if slim and walls[0]:  # cells that are not square
        bounds, domain = ((0.1, 1.3), *scene.bounds[1:]), ((0.05, 1.35), *scene.domain[1:])
        return dataclasses.replace(scene, bounds=bounds, domain=domain)
    return scene


def steps_of(emulator, particles):
    return type(steps_for(emulator, particles, emulator.solid(particles)))


def predict_both(emulator, particles):
    """A bundle's last positions and velocities in cells, by kernels and by tensor operations."""
    with torch.no_grad():
        assert steps_of(emulator, particles) is FusedSteps
        fused = emulator(particles)
        with without_kernels():
            assert steps_of(emulator, particles) is TensorSteps
            tensors = emulator(particles)
    spacing = torch.tensor(emulator.grid.spacing)
    return [torch.stack([b.position[:, -1], b.velocity]) / spacing for b in (fused, tensors)]


def share_that_differs(emulator, particles) -> float:
    """Share of the particles; one whose decision hangs on rounding (at rest or not, shortened or not) may differ."""
    fused, tensors = predict_both(emulator, particles)
    return ((fused - tensors).abs() > LIMIT).any(-1).any(0).float().mean().nan_to_num().item()


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


def case(dim, walls, transfer, decoder, bounds="stop", materials=1, obstacles=False, slim=False, **held):
    scene = scene_of(dim, walls, materials, obstacles, slim)
    return scene, {"transfer": transfer, "decoder": decoder, "constraints": Constraints(bounds=bounds, **held)}


CASES = {
    "free": case(2, (True, True), Linear(), Residual()),
    "energy": case(2, (True, True), Linear(), Flip(), energy=True),
    "at rest, reflected": case(2, (True, True), Nearest(), Blend(0.8), "reflect", 2, rest_speed=0.05),
    "crowded": case(2, (False, True), Linear(), Absolute(), materials=3, energy=True, density_cap=0.3),
    "slim cells": case(2, (True, True), Quadratic(), Acceleration(), slim=True, density_cap=0.3, **HELD),
    "obstacles": case(2, (True, True), Linear(), Residual(), obstacles=True, density_cap=0.3, **HELD),
    "3-D": case(3, (True, True, False), Linear(), Flip(), "reflect", 2, energy=True, density_cap=0.3),
    "3-D, quadratic": case(3, (False, True, True), Quadratic(), Acceleration(), rest_speed=0.05),
    "3-D, obstacles": case(3, (True, True, True), Linear(), Residual(), obstacles=True, density_cap=0.3, **HELD),
}


@pytest.mark.parametrize("name", CASES)
def test_bundles(name):
    scene, parts = CASES[name]
    particles = cloud(scene, 400, 2, 0.02, statics=20 * scene.obstacles)
    particles.mask[1, 200:] = False
    assert share_that_differs(emulator_of(scene, **parts), particles) <= 0.02


@pytest.mark.slow
@given(
    dim=st.integers(2, 3), walls=st.lists(st.booleans(), min_size=3, max_size=3), materials=st.integers(1, 3),
    transfer=st.sampled_from([Nearest(), Linear(), Quadratic()]), decoder=st.sampled_from(DECODERS),
    bounds=st.sampled_from(["stop", "reflect"]), energy=st.booleans(), cap=st.sampled_from([0.0, 0.3, 2.0]),
    rest=st.sampled_from([0.0, 0.05]), speed=st.sampled_from([0.0, 0.002, 0.05, 0.3]),
    scale=st.sampled_from([0.1, 1.0, 5.0]), count=st.sampled_from([0, 1, 17, 700]), batch=st.integers(1, 2),
    slim=st.booleans(), statics=st.sampled_from([0, 5, 30]), seed=st.integers(0, 1000),
)  # fmt: skip
@settings(max_examples=80, deadline=None)
def test_bundles_of_any_kind(
    dim, walls, materials, transfer, decoder, bounds, energy, cap, rest, speed, scale, count, batch, slim, statics, seed
):
    walls = [True] * 3 if statics else walls
    scene, parts = case(
        dim, walls, transfer, decoder, bounds, materials, statics > 0, slim and not statics, energy=energy,
        rest_speed=rest, density_cap=cap,
    )  # fmt: skip
    particles = cloud(scene, count, batch, speed, seed, statics)
    if batch > 1 and count:
        particles.mask[1, count // 2 :] = False
    share = share_that_differs(emulator_of(scene, scale=scale, seed=seed, **parts), particles)
    assert share <= 0.02 if count > 1 else share == 0 or rest or energy


@pytest.mark.parametrize("obstacles", [False, True])
@pytest.mark.parametrize(("dim", "cap"), [(2, 0.8), (3, 0.02)])
def test_crowds_spread_alike(dim, cap, obstacles):
    scene = scene_of(dim, (True, False, True), 2, obstacles, slim=True)
    emulator = emulator_of(scene, scale=0.01, constraints=Constraints(density_cap=cap))
    particles = cloud(scene, 600, 2, 0.0, statics=5 * obstacles)
    middle = torch.tensor([sum(ends) / 2 for ends in scene.bounds])
    particles.position[0] = middle + 0.02 * (particles.position[0] - middle)
    moved = predict_both(emulator, particles)[0][0] - predict_both(emulator.unconstrained(), particles)[0][0]
    assert moved[0].abs().max() > 10 * LIMIT
    assert share_that_differs(emulator, particles) <= 0.002


def test_single_frames_and_bfloat16():
    emulator = emulator_of(box(), frames=1, constraints=Constraints(rest_speed=0.01)).with_network(torch.bfloat16)
    assert share_that_differs(emulator, cloud(box(), 60)) == 0


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["position", "velocity"])
@pytest.mark.parametrize("walls", [[True, True], [False, True]])
def test_non_finite_inputs_stay_visible(bad, name, walls):
    scene = scene_of(2, walls)
    emulator, particles = emulator_of(scene), cloud(scene, 50)
    getattr(particles, name)[0, 3, 0] = bad
    fused, tensors = predict_both(emulator, particles)
    assert torch.equal(fused.isfinite().all(-1)[0, 0, 3], tensors.isfinite().all(-1)[0, 0, 3])
    if name == "velocity" or all(walls):  # a NaN as an index of a periodic axis is any node
        far = torch.arange(50) != 3
        torch.testing.assert_close(fused[:, 0, far], tensors[:, 0, far], rtol=1e-3, atol=LIMIT, equal_nan=True)


@pytest.mark.parametrize("kernels", [True, False])
def test_padding_changes_nothing_to_the_bit_however_fast_and_wherever_it_is(kernels):
    scene, slab = box(obstacles=True), lattice(((0.3, 0.7), (0.35, 0.5)), 0.02)[None]
    obstacle = {"obstacle": slab, "obstacle_mask": torch.ones(slab.shape[:2], dtype=torch.bool)}
    emulator = emulator_of(scene, cells=16, decoder=Flip(), constraints=Constraints(**HELD if kernels else {}))
    particles = dataclasses.replace(cloud(scene, 200, speed=0.02), **obstacle)
    padded = dataclasses.replace(cloud(scene, 260), **obstacle)
    for name in ("position", "velocity", "material"):
        getattr(padded, name)[:, :200] = getattr(particles, name)
    padded.mask[:, 200:] = False
    padded.position[:, 200:230], padded.velocity[:, 230:] = slab[:, :30], 0.4
    with torch.no_grad():
        if kernels:
            assert torch.equal(emulator(padded).position[:, :, :200], emulator(particles).position)
        else:
            with without_kernels():
                assert torch.equal(emulator(padded).position[:, :, :200], emulator(particles).position)


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
    for name in ("call.CHUNK", "contact.CHUNK", "path.CHUNK", "rest.CHUNK", "state._CHUNK"):
        monkeypatch.setattr(f"nmpm.emulator.fused.{name}", 256)
    emulator = emulator_of(scene, constraints=Constraints(**HELD)).requires_grad_(False)
    particles = cloud(scene, 3000, 2, statics=20)
    call = KernelCall(emulator, emulator.kernel_parameters, emulator.context(particles))
    output = torch.randn(2, emulator.frames, 2, *emulator.grid.shape)

    def move():
        start = call.rasterise(particles)
        return call.finish(start, call.path(start, output)).position

    assert torch.equal(*with_threads((1, 3), move))


def test_rollouts_go_on_from_the_middle_and_scenes_are_as_alone_to_the_bit():
    scene = box(materials=("water", "sand"), obstacles=True)
    emulator, particles = emulator_of(scene, constraints=Constraints(**HELD)), cloud(scene, 80, 2, 0.02, statics=10)
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
        emulator_of(scene)(particles)


def test_what_has_no_kernels_takes_tensor_operations():
    scene, particles = box(), cloud(box(), 10)
    unknown = emulator_of(scene, transfer=type("Own", (Linear,), {})())
    assert steps_of(emulator_of(scene), particles) is TensorSteps  # the weights want gradients
    assert steps_of(emulator_of(scene).train(), particles) is TrainingSteps
    for parts in ({"transfer": Quadratic()}, {"constraints": Constraints(bounds="reflect")}):
        assert steps_of(emulator_of(scene, **parts).train(), particles) is TensorSteps
    assert steps_of(emulator_of(scene_of(3, (True,) * 3)).train(), cloud(scene_of(3, (True,) * 3))) is TensorSteps
    with torch.no_grad():
        assert steps_of(emulator_of(scene), particles) is FusedSteps
        assert steps_of(emulator_of(scene), particles.double()) is TensorSteps
        for other in (unknown, emulator_of(scene, constraints=Constraints(bounds="error")), unknown.double()):
            assert steps_of(other, particles) is TensorSteps
    moving = dataclasses.replace(particles, velocity=particles.velocity.requires_grad_())
    assert steps_of(emulator_of(scene).requires_grad_(False), moving) is TensorSteps


@pytest.mark.slow
def test_traced_graphs_take_tensor_operations():
    emulator, particles = emulator_of(box(), constraints=Constraints(energy=True)), cloud(box(), 30)

    def call(position, velocity):
        return emulator(particles.with_motion(position, velocity)).position

    with torch.no_grad():
        traced = torch.compile(call, backend="eager")(particles.position, particles.velocity)
        torch.testing.assert_close(traced, emulator(particles).position, rtol=0, atol=1e-6)


def test_importing_nmpm_and_loading_a_model_do_not_import_numba():
    code = "import sys; from nmpm.zoo import Zoo; Zoo.load('goop'); assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_cached_arrays_follow_their_tensors_and_copies_are_not_kept():
    cache, values = ArrayCache(), torch.arange(6.0).reshape(2, 3)
    first = cache.array("values", values)
    assert cache.array("values", values) is first
    values += 1
    assert np.array_equal(first, values.numpy())
    assert np.array_equal(cache.array("values", values + 1), (values + 1).numpy())
    values.data = torch.zeros(2, 3)
    assert not cache.array("values", values).any()
    turned = torch.arange(6.0).reshape(2, 3).T
    assert cache.array("turned", turned).flags.c_contiguous
    turned += 1
    assert np.array_equal(cache.array("turned", turned), turned.numpy())


@pytest.mark.parametrize("change", ["statistics", "gravity", "mask"])
def test_a_rollouts_context_follows_what_changes(change):
    scene = box(obstacles=True)
    emulator, particles = emulator_of(scene, constraints=Constraints(energy=True)), cloud(scene, 60, statics=5)
    emulator.requires_grad_(False)
    context = emulator.context(particles)
    before = emulator(particles, context).position
    if change == "statistics":
        emulator.output_scale.mul_(3)
    elif change == "gravity":
        particles = dataclasses.replace(particles, gravity=-particles.gravity)
    else:
        particles.mask[:, 40:] = False
    unprepared = dataclasses.replace(context, array_cache=None)
    assert not torch.equal(emulator(particles, context).position, before)
    assert torch.equal(emulator(particles, context).position, emulator(particles, unprepared).position)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_network_sees_what_tensor_operations_give(dim):
    scene = box(dim, ("water", "sand"), obstacles=True)
    emulator, particles = emulator_of(scene, cells=8).requires_grad_(False), cloud(scene, 60, 2, statics=5)
    particles.velocity[0, 0, 0] = float("nan")
    emulator.input_low.fill_(-0.01)
    emulator.input_high.fill_(0.3)
    emulator.input_mean.copy_(torch.randn_like(emulator.input_mean))
    emulator.input_std.copy_(1 + torch.rand_like(emulator.input_std))
    call = KernelCall(emulator, emulator.kernel_parameters, emulator.context(particles))
    start = call.rasterise(particles)
    expected = emulator.normalise(as_grid(start.state, emulator.grid.shape))
    assert expected.isnan().any()
    torch.testing.assert_close(call.normalise(start), expected, rtol=1e-6, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (0, 3, 4, 1, 2)])
def test_outputs_of_any_layout_are_unpacked(precision, order):
    shape = (2, 3, 4, 9, 10)
    back = [order.index(axis) for axis in range(5)]
    output, scale = torch.randn([shape[axis] for axis in order]).permute(back).to(precision), torch.rand(3, 4, 1, 1)
    arrays, unpack = output_arrays(output)
    fields = np.empty((3, 90, 4), np.float32)
    unpack(arrays[1], scale.numpy().reshape(-1), fields)
    assert torch.equal(torch.from_numpy(fields), (output[1].float() * scale).flatten(2).transpose(1, 2))
