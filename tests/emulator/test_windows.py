"""The network on windows gives what it gives on the whole grid, to rounding, wherever particles read it."""

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud
from torch import nn

from nmpm.decoders import Absolute
from nmpm.emulator import Emulator, EmulatorRecipe, rollout
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.runtimes import Eager
from nmpm.emulator.windows import UncoveredReadError, Windows, choose_windows
from nmpm.emulator.windows.axis import BLOCK, READ, Axis
from nmpm.emulator.windows.cover import cover_scene
from nmpm.emulator.windows.network import mark_readable, predict_windows
from nmpm.emulator.windows.occupied import readable_blocks
from nmpm.emulator.windows.reads import check_reads
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors import Axial, ConvNeXt, GridLayout, Patched, Pointwise, UNet, UNetModern
from nmpm.transfer import Linear, using

SMALL = UNet(width=4, depth=1, perceptron=(5,))  # sees 9 cells
ALWAYS = Windows(least_cells=1)
LIMIT = 1e-4  # cells

axes_of_any_kind = st.builds(
    Axis,
    cells=st.integers(1, 40).map(lambda n: 8 * n),  # a multiple of the alignment, as periodic axes need
    periodic=st.booleans(),
    radius=st.integers(0, 30),
    alignment=st.sampled_from([1, 2, 4, 8]),
)


@given(axis=axes_of_any_kind, odd=st.integers(0, 7), data=st.data())
@settings(max_examples=50, deadline=None)
def test_a_window_suits_the_network_and_holds_its_blocks(axis, odd, data):
    axis = axis if axis.periodic else dataclasses.replace(axis, cells=axis.cells + odd)
    first = data.draw(st.integers(0, axis.blocks - 1))
    last = data.draw(st.integers(first + 1, axis.blocks))
    start, length = map(int, axis.span(first, last))
    assert start % axis.alignment == 0
    assert length == axis.cells or (length < axis.cells and (length - axis.cells) % axis.alignment == 0)
    assert axis.periodic or 0 <= start <= axis.cells - length
    low, count = axis.inner(start, length, axis.halo)
    assert low <= first * BLOCK
    assert low + count >= min(last * BLOCK, axis.cells)
    pieces = axis.pieces(start, length)
    everywhere = np.arange(axis.cells)
    assert np.concatenate([everywhere[there] for there, _ in pieces]).tolist() == [
        (start + step) % axis.cells for step in range(length)
    ]


@given(
    shape=st.sampled_from([(150, 90), (77, 100), (40, 30, 20)]),
    share=st.sampled_from([0.0, 0.02, 0.2, 1.0]),
    periodic=st.booleans(),
    most=st.sampled_from([1, 4000, 10**9]),
    seed=st.integers(0, 100),
)
@settings(max_examples=12, deadline=None)
def test_windows_cover_all_marked_blocks(shape, share, periodic, most, seed):
    shape = (160, *shape[1:]) if periodic else shape
    axes = [Axis(cells, periodic and not index, 9, 2) for index, cells in enumerate(shape)]
    blocks = np.random.default_rng(seed).random([axis.blocks for axis in axes]) < share
    windows = cover_scene(blocks, axes, 0, most)
    readable = mark_readable(windows, axes, 1, torch.device("cpu"))[0]
    for place in np.argwhere(blocks):
        cells = tuple(slice(i * BLOCK, (i + 1) * BLOCK) for i, axis in zip(place, axes, strict=True))
        assert readable[cells].all()
    least = np.prod([min(axis.cells, BLOCK + 3 * axis.halo + 32) for axis in axes])
    assert all(window.cells <= max(most, least) for window in windows)


def test_two_distant_drops_get_a_window_each():
    axes = [Axis(256, False, 9, 2)] * 2
    blocks = np.zeros((64, 64), np.bool_)
    blocks[4:8, 4:8] = blocks[56:60, 50:54] = True
    one, other = cover_scene(blocks, axes, 0, 10**9)
    assert one.cells == other.cells < 64**2


@pytest.mark.parametrize(
    "processor",
    [SMALL, UNetModern(width=4, growth=(1, 2)), ConvNeXt(width=4, depth=1, kernel=3), Patched(SMALL), Pointwise()],
    ids=lambda recipe: type(recipe).__name__,
)
@pytest.mark.parametrize(
    ("shape", "periodic"),
    [((100, 75), (False, False)), ((96, 75), (True, False)), ((75, 48, 5), (False, True, False))],
)
def test_windows_of_a_network_are_parts_of_its_output(processor, shape, periodic):
    torch.manual_seed(0)
    network = processor.build(GridLayout(3, 2, 2, periodic)).eval()
    axes = [Axis(n, wraps, network.radius, network.alignment) for n, wraps in zip(shape, periodic, strict=True)]
    grid = torch.randn(2, 3, *shape)
    blocks = np.zeros((2, *(axis.blocks for axis in axes)), np.bool_)
    blocks[0, 0, 0] = blocks[0, -1, -1] = blocks[1, 9, 7] = True
    windows = [window for scene in range(2) for window in cover_scene(blocks[scene], axes, scene, 10**9)]
    assert sum(window.cells for window in windows) < 2 * grid[0, 0].numel()
    with torch.no_grad():
        whole, parts = network(grid), predict_windows(network, grid, windows, axes, 10**9)
    assert parts.shape == whole.shape
    readable = mark_readable(windows, axes, 2, grid.device)
    difference = ((parts - whole).abs() * readable[:, None, None]).max()
    assert difference < 1e-5


def test_blocks_follow_the_velocity():
    axes = [Axis(64, False, 3, 1), Axis(64, True, 3, 1)]
    state = torch.zeros(2, 3, 64, 64)
    state[0, :, 33, 1] = torch.tensor([2.0, -1.0, 0.5])  # 20 cells up and 10 down in 8 frames, 3 more each
    found = readable_blocks(state, 1, 8, axes)
    assert not found[1].any()
    rows, columns = np.nonzero(found[0])
    assert set(rows) == set(range(7, 15))  # cells from 32 - 3 to 35 + 23
    assert set(columns) == {12, 13, 14, 15, 0, 1}  # from 0 - 13 to 3 + 3


def emulator_of(scene, cells=96, processor=SMALL, scale=0.1, frames=4, **parts) -> Emulator:
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, cells, frames, processor=processor, **parts).build().eval()
    emulator.output_scale.mul_(scale)
    return emulator.with_windows(ALWAYS)


def drops(scene, count=200, batch=1, speed=0.002, seed=0, **changes):
    """Particles in the middle of the box, those of each scene in a small cloud of its own."""
    particles = cloud(scene, count, batch, speed, seed, **changes)
    centre = 0.2 + 0.6 * torch.rand(batch, 1, scene.dim, generator=torch.Generator().manual_seed(seed))
    return dataclasses.replace(particles, position=(centre + 0.2 * (particles.position - 0.5)).clamp(0.101, 0.899))


def coverage_of(emulator, particles):
    """What a call chooses."""
    chosen = []
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "nmpm.emulator.outputs.choose_windows", lambda *these: chosen.append(choose_windows(*these)) or chosen[-1]
        )
        emulator(particles)
    return chosen[0] if chosen else None


def assert_same_rollout(emulator, particles, frames=12, limit=LIMIT):
    windows, whole = (rollout(e, particles, frames) for e in (emulator, emulator.with_windows(None)))
    assert ((windows - whole) / torch.tensor(emulator.grid.spacing)).abs().max() < limit


CHANNEL = {"boundary": ("periodic", "wall"), "domain": ((0.1, 0.9), (0.08, 0.92))}
SCENES = {
    "walls": box(),
    "two materials": box(materials=("water", "sand")),
    "obstacles": box(obstacles=True),
    "periodic": box(obstacles=True, **CHANNEL),
    "three axes": box(3),
}


@pytest.mark.parametrize("path", ["kernels", "tensors"])
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_a_bundle_is_that_of_the_whole_grid(scene, path):
    constraints = Constraints(energy=True, rest_speed=0.01)
    cells, processor = ([96, 92], SMALL) if scene.dim == 2 else (40, UNet(width=4, depth=0, perceptron=(5,)))
    emulator = emulator_of(scene, cells, processor, transfer=Linear(), constraints=constraints)
    chosen = 0
    for seed, speed in enumerate((0.0, 0.02)):
        particles = drops(scene, 100, 2, speed, seed, statics=5 * scene.obstacles)
        with using("native") if path == "tensors" else nullcontext():
            assert_same_rollout(emulator, particles, 4, 1e-3)
        chosen += coverage_of(emulator, particles) is not None
    assert chosen


def test_a_rollout_is_that_of_the_whole_grid():
    emulator, particles = emulator_of(box()), drops(box(), batch=2)
    coverage = coverage_of(emulator, particles)
    assert coverage.cells < 96**2
    assert_same_rollout(emulator, particles, 40)


@pytest.mark.parametrize("native", [False, True])
@pytest.mark.parametrize("obstacles", [False, True])
def test_particles_that_leave_their_windows_are_computed_on_the_whole_grid(native, obstacles, monkeypatch):
    scene = box(obstacles=obstacles)
    emulator = emulator_of(scene, scale=60.0, decoder=Absolute(), constraints=Constraints(rest_speed=0.01))
    particles = drops(scene, 50, statics=5 * obstacles)
    seen = []
    emulator.processor.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][0, 0].numel()))
    with torch.no_grad(), using("native" if native else None) if native else torch.no_grad():
        windows = emulator(particles)
        calls, seen[:] = list(seen), []
        whole = emulator.with_windows(None)(particles)
    assert calls[0] < calls[1] == seen[0] == emulator.grid.size
    assert torch.equal(windows.position, whole.position)


def test_reads_outside_are_found_by_frame_and_not_for_padding():
    grid = Grid((8, 8), (0.0, 0.0), (1.0, 1.0), (True, False))
    readable = torch.zeros(1, 8, 8, dtype=torch.bool)
    readable[:, :2] = True
    start = torch.tensor([[[0.5, 4.0], [1.9, -3.0], [8.5, 9.0]]])  # walls stop, periodic axes wrap
    path = torch.stack([start, start + torch.tensor([4.0, 0.0])], dim=1)
    mask = torch.ones(1, 3, dtype=torch.bool)
    check_reads(start, path, mask, readable, grid)  # nothing is interpolated at the last frame
    with pytest.raises(UncoveredReadError):
        check_reads(start, path.flip(1), mask, readable, grid)
    check_reads(start, path.flip(1), ~mask, readable, grid)


@pytest.mark.parametrize("cells", [64, 32])
def test_memory_is_bounded_by_the_cells_computed_at_once(cells):
    scene = box()
    emulator, particles = emulator_of(scene, 128), cloud(scene, 3000, batch=2)
    most = cells**2
    bounded = emulator.with_windows(Windows(least_cells=1, most_cells=most))
    seen = []
    emulator.processor.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][:, 0].numel()))
    with torch.no_grad():
        one = bounded(particles)
        assert max(seen) <= max(most, 48**2)
        whole = emulator.with_windows(None)(particles)
    assert seen[-1] == 2 * 128**2
    assert ((one.position - whole.position) / emulator.grid.spacing[0]).abs().max() < LIMIT


def test_memory_is_bounded_when_particles_leave_their_windows():
    scene = box()
    emulator = emulator_of(scene, 128, scale=60.0, decoder=Absolute())
    bounded = emulator.with_windows(Windows(least_cells=1, most_cells=64**2))
    particles, seen = drops(scene, 50), []
    emulator.processor.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][:, 0].numel()))
    with torch.no_grad():
        one = bounded(particles)
        assert max(seen) <= 64**2
        assert sum(seen) > 128**2
        whole = emulator.with_windows(None)(particles)
    assert ((one.position - whole.position) / emulator.grid.spacing[0]).abs().max() < LIMIT


def test_the_whole_grid_is_computed_where_windows_do_not_suit():
    scene = box()
    particles = drops(scene)
    assert coverage_of(emulator_of(scene), particles) is not None
    assert coverage_of(emulator_of(scene).with_windows(None), particles) is None
    assert coverage_of(emulator_of(scene).with_windows(Windows(least_cells=96**2 + 1)), particles) is None
    assert coverage_of(emulator_of(scene).with_windows(Windows(1, device_types=("cuda",))), particles) is None
    assert coverage_of(emulator_of(scene, processor=Axial(width=8, layers=1, heads=2)), particles) is None
    assert coverage_of(emulator_of(scene).train(), particles) is None
    full = cloud(scene, 9000)
    full.position.copy_(0.1 + 0.8 * torch.rand(1, 9000, 2))
    assert coverage_of(emulator_of(scene), full) is None


def test_runtimes_that_compile_each_shape_are_given_the_whole_grid():
    emulator, particles = emulator_of(box()), drops(box())
    emulator.runtime = type("Compiled", (Eager,), {"fixed_shapes": True})()
    assert coverage_of(emulator, particles) is None


def test_gradients_are_those_of_the_whole_grid():
    emulator, particles = emulator_of(box()), drops(box())
    start = particles.position.requires_grad_()
    emulator(particles).position.sum().backward()
    assert start.grad.isfinite().all()
    assert all(weight.grad is not None for weight in emulator.parameters())


def test_networks_that_are_no_grid_processors_are_computed_whole():
    emulator, particles = emulator_of(box()), drops(box())
    emulator.processor = nn.Sequential(emulator.processor)
    assert coverage_of(emulator, particles) is None


def test_compiled_networks_and_traced_graphs_are_computed_whole():
    emulator, particles = emulator_of(box()), drops(box())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torch.compiler.is_compiling", lambda: True)
        assert coverage_of(emulator, particles) is None
    assert coverage_of(emulator, particles) is not None
    emulator.processor._compiled_call_impl = emulator.processor._call_impl
    assert coverage_of(emulator, particles) is None


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["position", "velocity"])
def test_non_finite_values_stay_visible(bad, name):
    emulator, particles = emulator_of(box()), drops(box())
    getattr(particles, name)[0, 3, 0] = bad
    with torch.no_grad():
        windows, whole = (e(particles).velocity.isfinite() for e in (emulator, emulator.with_windows(None)))
    assert torch.equal(windows[0, 3], whole[0, 3])


def test_scenes_without_particles():
    emulator = emulator_of(box())
    assert rollout(emulator, cloud(box(), 0), 5).shape == (1, 5, 0, 2)


def test_options_are_checked_and_kept_in_other_scenes():
    with pytest.raises(ConfigError, match="most_cells = 0"):
        Windows(most_cells=0)
    emulator = emulator_of(box())
    assert emulator.over(box()).windows is ALWAYS
    assert emulator.with_constraints(Constraints()).windows is ALWAYS
    assert READ == 1
