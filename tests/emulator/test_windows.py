"""The network on windows gives what it gives on the whole grid, to rounding, wherever particles read it."""

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest
import torch

from nmpm.decoders import Absolute
from nmpm.emulator import Emulator, Windows, rollout
from nmpm.emulator.runtimes.windows import BLOCK, Axis, cover_blocks, predict_on_crops
from nmpm.errors import ConfigError
from nmpm.processors import Axial, ConvNeXt, GridLayout, Patched, UNet
from nmpm.transfer import without_kernels
from tests.scenes import CHANNEL, box, cloud, emulator_of

SMALL = UNet(width=4, depth=1, perceptron=(5,))  # sees 9 cells


@pytest.mark.parametrize("most", [1, 10**9])
@pytest.mark.parametrize(
    ("processor", "shape", "periodic"),
    [
        (SMALL, (100, 75), (False, False)),
        (ConvNeXt(width=4, depth=1, kernel=3), (96, 75), (True, False)),
        (Patched(SMALL), (75, 48, 5), (False, True, False)),
    ],
    ids=repr,
)
def test_a_network_on_crops_gives_its_output_in_all_marked_blocks(processor, shape, periodic, most):
    torch.manual_seed(0)
    network = processor.build(GridLayout(3, 2, 2, periodic)).eval()
    axes = [Axis(n, wraps, network.radius, network.alignment) for n, wraps in zip(shape, periodic, strict=True)]
    grid, blocks = torch.randn(2, 3, *shape), np.zeros((2, *(axis.blocks for axis in axes)), np.bool_)
    blocks[0, 0, 0] = blocks[0, -1, -1] = blocks[1, 9, 7] = True
    crops = [crop for scene in range(2) for crop in cover_blocks(blocks[scene], axes, scene, most)]
    assert sum(crop.cells for crop in crops) < 2 * grid[0, 0].numel()
    with torch.no_grad():
        whole, parts = network(grid), predict_on_crops(network, grid, crops, axes, most)
    read = parts.isfinite().all(2).all(1)
    for place in np.argwhere(blocks):
        cells = [slice(i * BLOCK, (i + 1) * BLOCK) for i in place[1:]]
        assert read[(place[0], *cells)].all()
    assert (parts - whole).abs().nan_to_num(0).max() < 1e-5


def large(scene, cells=96, processor=SMALL, scale=0.1, **parts) -> Emulator:
    return emulator_of(scene, cells, processor=processor, scale=scale, **parts).requires_grad_(False)


def drops(scene, count=200, batch=1, speed=0.002, seed=0, **changes):
    """Particles in the middle of the box, those of each scene in a small cloud of its own."""
    particles = cloud(scene, count, batch, speed, seed, **changes)
    centre = 0.2 + 0.6 * torch.rand(batch, 1, scene.dim, generator=torch.Generator().manual_seed(seed))
    return dataclasses.replace(particles, position=(centre + 0.2 * (particles.position - 0.5)).clamp(0.101, 0.899))


def cells_computed(emulator: Emulator) -> list[int]:
    """A list to which each call of the network adds its cells."""
    cells: list[int] = []
    emulator.processor.register_forward_pre_hook(lambda _, inputs: cells.append(inputs[0][:, 0].numel()))
    return cells


SCENES = {
    "two materials": box(materials=("water", "sand")),
    "periodic": box(obstacles=True, **CHANNEL),
    "three axes": box(3),
    "fields": box(evolving=("temperature",)),
}
by_kernels_and_tensors = pytest.mark.parametrize("kernels", [True, False], ids=["kernels", "tensors"])


@by_kernels_and_tensors
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_a_bundle_is_that_of_the_whole_grid(scene, kernels):
    cells, processor = ((96, 92), SMALL) if scene.dim == 2 else (40, UNet(width=4, depth=0, perceptron=(5,)))
    emulator = large(scene, cells, processor, energy=True, rest_speed=0.01)
    computed, particles = cells_computed(emulator), drops(scene, 100, 2, 0.004, statics=5 * scene.obstacles)
    if scene.fields:
        particles = particles.with_fields({"temperature": particles.position[..., 0]})
    with nullcontext() if kernels else without_kernels():
        parts, whole = (rollout(e, particles, 4) for e in (emulator.with_runtime("windows"), emulator))
    assert ((parts - whole) / torch.tensor(emulator.grid.spacing)).abs().max() < 1e-3
    assert min(computed) < 0.85 * 2 * emulator.grid.size


@by_kernels_and_tensors
@pytest.mark.parametrize("obstacles", ["none", "beside", "around all"])
def test_particles_that_leave_their_windows_are_computed_on_the_whole_grid(kernels, obstacles):
    scene = box(obstacles=obstacles != "none")
    emulator = large(scene, scale=60.0, decoder=Absolute(), rest_speed=0.01)
    particles, computed = drops(scene, 50, statics=50 * scene.obstacles), cells_computed(emulator)
    if obstacles == "around all":  # they are pushed out, which must not hide that they have read what was not computed
        particles = dataclasses.replace(particles, obstacle=particles.position)
    with nullcontext() if kernels else without_kernels():
        parts, whole = emulator.with_runtime("windows")(particles), emulator(particles)
    assert computed[0] < computed[1] == computed[2] == emulator.grid.size
    assert torch.equal(parts.position, whole.position)


@pytest.mark.parametrize("scale", [0.1, 60.0], ids=["in windows", "beyond"])
def test_memory_is_bounded_by_the_cells_computed_at_once(scale):
    emulator, particles = large(box(), 128, scale=scale, decoder=Absolute()), drops(box(), 50)
    computed = cells_computed(emulator)
    parts = emulator.with_runtime(Windows(most_cells=64**2))(particles)
    assert max(computed) <= 64**2
    assert (sum(computed) > 128**2) == (scale > 1)
    assert ((parts.position - emulator(particles).position) / emulator.grid.spacing[0]).abs().max() < 1e-4


def test_the_whole_grid_is_computed_where_windows_do_not_pay():
    emulator, full = large(box()), cloud(box(), 9000)
    full.position.copy_(0.1 + 0.8 * torch.rand(1, 9000, 2))
    computed = cells_computed(emulator)
    assert torch.equal(emulator.with_runtime("windows")(full).position, emulator(full).position)
    assert computed == 2 * [emulator.grid.size]


def test_what_windows_cannot_do_is_refused():
    with pytest.raises(ConfigError, match="networks that may see the whole grid, of no known radius: use eager"):
        large(box(), processor=Axial(width=8, layers=1, heads=2)).with_runtime("windows")
    with pytest.raises(ConfigError, match="no gradients"):
        large(box()).requires_grad_(True).with_runtime("windows")(drops(box()))
    with pytest.raises(ConfigError, match="most_cells = 0"):
        Windows(most_cells=0)


@pytest.mark.parametrize("name", ["position", "velocity"])
def test_non_finite_values_stay_visible(name):
    emulator, particles = large(box()), drops(box())
    getattr(particles, name)[0, 3, 0] = torch.nan
    parts, whole = (e(particles).velocity.isfinite() for e in (emulator.with_runtime("windows"), emulator))
    assert torch.equal(parts[0, 3], whole[0, 3])
