"""Calls by arrays: what they keep of a rollout follows its tensors; their kernels give what tensor operations do."""

import dataclasses

import numpy as np
import pytest
import torch
from scenes import box, cloud

from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.fused.arrays import ArrayCache, as_grid
from nmpm.emulator.fused.call import KernelCall
from nmpm.emulator.fused.state import output_arrays
from nmpm.processors import Pointwise
from nmpm.transfer import without_kernels


def small_emulator(scene, **parts):
    torch.manual_seed(0)
    return EmulatorRecipe(scene, 8, 4, processor=Pointwise(hidden=(4,)), **parts).build().eval().requires_grad_(False)


def test_views_follow_their_tensors():
    views, values = ArrayCache(), torch.arange(6.0).reshape(2, 3)
    first = views.array("values", values)
    assert views.array("values", values) is first
    values += 1
    assert np.array_equal(first, values.numpy())
    assert np.array_equal(views.array("values", values + 1), (values + 1).numpy())
    values.data = torch.zeros(2, 3)
    assert not views.array("values", values).any()


def test_copies_are_not_kept():
    views, values = ArrayCache(), torch.arange(6.0).reshape(2, 3).T
    assert views.array("values", values).flags.c_contiguous
    values += 1
    assert np.array_equal(views.array("values", values), values.numpy())


@pytest.mark.parametrize("change", ["statistics", "gravity", "mask"])
def test_a_rollouts_context_follows_what_changes(change):
    scene = box(obstacles=True)
    emulator, particles = small_emulator(scene, constraints=Constraints(energy=True)), cloud(scene, 60, statics=5)
    context = emulator.context(particles)
    before = emulator(particles, context).position
    if change == "statistics":
        emulator.output_scale.mul_(3)
        emulator.input_mean.add_(0.2)
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
    emulator, particles = small_emulator(scene), cloud(scene, 60, 2, statics=5)
    particles.velocity[0, 0, 0] = float("nan")
    emulator.input_low.fill_(-0.01)
    emulator.input_high.fill_(0.3)
    emulator.input_mean.copy_(torch.randn_like(emulator.input_mean))
    emulator.input_std.copy_(1 + torch.rand_like(emulator.input_std))
    call = KernelCall(emulator, emulator.kernel_parameters, emulator.context(particles))
    start = call.rasterise(particles)
    state = as_grid(start.state, emulator.grid.shape)
    expected = emulator.normalise(state)
    assert expected.isnan().any()
    torch.testing.assert_close(call.normalise(start), expected, rtol=1e-6, atol=1e-6, equal_nan=True)
    assert call.normalise(start).stride()[1:] == state.stride()[1:]


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (0, 3, 4, 1, 2), (0, 2, 3, 4, 1)])
def test_outputs_of_any_layout_are_unpacked(precision, order):
    shape = (2, 3, 4, 9, 10)
    back = [order.index(axis) for axis in range(5)]
    output = torch.randn([shape[axis] for axis in order]).permute(back).to(precision)
    scale = torch.rand(3, 4, 1, 1)
    arrays, unpack = output_arrays(output)
    fields = np.empty((3, 90, 4), np.float32)
    unpack(arrays[1], scale.numpy().reshape(-1), fields)
    expected = (output[1].float() * scale).flatten(2).transpose(1, 2)
    assert torch.equal(torch.from_numpy(fields), expected)


def test_single_frames_and_bfloat16_are_as_with_tensor_operations():
    scene = box()
    torch.manual_seed(0)
    recipe = EmulatorRecipe(scene, 8, 1, processor=Pointwise(hidden=(4,)), constraints=Constraints(rest_speed=0.01))
    emulator = recipe.build().eval().requires_grad_(False).with_network(torch.bfloat16)
    particles = cloud(scene, 60)
    kernels = emulator(particles)
    with without_kernels():
        tensors = emulator(particles)
    torch.testing.assert_close(kernels.position, tensors.position, rtol=0, atol=1e-5)
    torch.testing.assert_close(kernels.velocity, tensors.velocity, rtol=0, atol=1e-5)
