"""Kernels between particles and grid, in Triton: what `nmpm.emulator.rasterise` computes.

Particles are rows (B N, 2), nodes rows (B size, channels), the last axis of the grid fastest; a program treats a block
of them in the scene `program_id(1)`. The grid has (nx, ny) nodes; all is in cells. Names in capitals are known when a
kernel is compiled: which axes wrap, the number of materials, what a model has.
"""

import triton
import triton.language as tl

LEAST = tl.constexpr(1e-30)
"""Of a particle: where a node sees less, gradients of its means would overflow."""

SIZES = (
    "nx", "ny", "size", "count", "tiles", "entries", "frame", "frames", "channels", "outputs", "per_scene", "per_frame",
    "per_channel", "per_row", "per_column", "per_end", "per_axis", "apart",
    "cells_apart", "path_apart",
)  # fmt: skip
"""Numbers that a kernel is not compiled for: models and batches differ in them."""


@triton.jit
def find_nodes(x, extent, WRAPS: tl.constexpr):
    """The two nodes around a place along an axis, and the upper one's weight, which is NaN where the place is."""
    if WRAPS:
        inside = x - tl.floor(x / extent) * extent
        inside = tl.where((inside < 0) | (inside >= extent), 0.0, inside)
        offset = inside - 0.5
        base = tl.floor(offset)
        lower = tl.where(base == base, base, 0.0).to(tl.int32)
        upper = tl.where(lower + 1 >= extent, 0, lower + 1)
        lower = tl.where(lower < 0, extent - 1, lower)
    else:
        offset = tl.where(x < 0.5, 0.0, x - 0.5)
        offset = tl.where(offset > extent - 1, extent - 1.0, offset)
        base = tl.floor(offset)
        lower = tl.where(base == base, base, 0.0).to(tl.int32)
        upper = tl.minimum(lower + 1, extent - 1)
    return lower, upper, offset - base


@triton.jit
def interpolate(values, x, y, row, column, active, nx, ny, WX: tl.constexpr, WY: tl.constexpr):
    """Values whose nodes lie `row` and `column` apart along the axes, linearly interpolated at places (x, y)."""
    i0, i1, a = find_nodes(x, nx, WX)
    j0, j1, b = find_nodes(y, ny, WY)
    low = (1 - b) * tl.load(values + i0 * row + j0 * column, mask=active, other=0.0).to(tl.float32)
    low += b * tl.load(values + i0 * row + j1 * column, mask=active, other=0.0).to(tl.float32)
    high = (1 - b) * tl.load(values + i1 * row + j0 * column, mask=active, other=0.0).to(tl.float32)
    high += b * tl.load(values + i1 * row + j1 * column, mask=active, other=0.0).to(tl.float32)
    return (1 - a) * low + a * high


@triton.jit
def _add(sums, node, weight, u, v, kind, active, MATERIALS: tl.constexpr):
    row = sums + node * (3 * MATERIALS)
    tl.atomic_add(row + 2 * kind, weight * u, mask=active, sem="relaxed")
    tl.atomic_add(row + 2 * kind + 1, weight * v, mask=active, sem="relaxed")
    tl.atomic_add(row + 2 * MATERIALS + kind, weight, mask=active, sem="relaxed")


@triton.jit
def load_kind(material, row, active, BLOCK: tl.constexpr, MATERIALS: tl.constexpr):
    """Indices of materials, which may be out of range."""
    kind = tl.zeros((BLOCK,), tl.int32)
    if MATERIALS > 1:
        kind = tl.load(material + row, mask=active, other=0).to(tl.int32)
    return kind


@triton.jit(do_not_specialize=SIZES)
def scatter(position, velocity, gravity, material, volume, cells, moved, pull, sums, count, apart, low_x, low_y, wide_x,
            wide_y, nx, ny, WX: tl.constexpr, WY: tl.constexpr, MATERIALS: tl.constexpr, CONVERT: tl.constexpr,
            BLOCK: tl.constexpr):  # fmt: skip
    """Add momenta and volumes of particles to `sums` (B size, 2 M + M) of each material.

    `volume` (B, N) are multiples of the scene's, 0 for padding. If CONVERT, positions (B, N, 2), velocities (B, N, 2)
    and gravity (B, 2) are in domain length, and `cells`, whose scenes are `apart` particles apart, `moved` and `pull`
    are filled with those in cells.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < count, scene * count + p
    share = tl.load(volume + row, mask=inside, other=0).to(tl.float32)
    x, y = tl.load(position + 2 * row, mask=inside, other=0.0), tl.load(position + 2 * row + 1, mask=inside, other=0.0)
    u, v = tl.load(velocity + 2 * row, mask=inside, other=0.0), tl.load(velocity + 2 * row + 1, mask=inside, other=0.0)
    if CONVERT:
        x, y = ((x - low_x) / wide_x).to(tl.float32), ((y - low_y) / wide_y).to(tl.float32)
        u, v = (u / wide_x).to(tl.float32), (v / wide_y).to(tl.float32)
        tl.store(cells + 2 * (scene * apart + p), x, mask=inside)
        tl.store(cells + 2 * (scene * apart + p) + 1, y, mask=inside)
        tl.store(moved + 2 * row, u, mask=inside)
        tl.store(moved + 2 * row + 1, v, mask=inside)
        tl.store(pull + 2 * scene, (tl.load(gravity + 2 * scene) / wide_x).to(tl.float32))  # by all of its programs
        tl.store(pull + 2 * scene + 1, (tl.load(gravity + 2 * scene + 1) / wide_y).to(tl.float32))
    kind = load_kind(material, row, inside, BLOCK, MATERIALS)
    active = inside & (share > 0) & (kind >= 0) & (kind < MATERIALS)
    i0, i1, a = find_nodes(x, nx, WX)
    j0, j1, b = find_nodes(y, ny, WY)
    nodes = sums + scene * (nx * ny * 3 * MATERIALS)
    _add(nodes, i0 * ny + j0, share * (1 - a) * (1 - b), u, v, kind, active, MATERIALS)
    _add(nodes, i0 * ny + j1, share * (1 - a) * b, u, v, kind, active, MATERIALS)
    _add(nodes, i1 * ny + j0, share * a * (1 - b), u, v, kind, active, MATERIALS)
    _add(nodes, i1 * ny + j1, share * a * b, u, v, kind, active, MATERIALS)


@triton.jit
def _fill(state, seen, low, high, mean, deviation, row, channel, value, active, SEEN: tl.constexpr):
    """Store a channel's values at nodes' rows, and if SEEN, what the network sees of them."""
    tl.store(state + row + channel, value, mask=active)
    if SEEN:
        lowest, highest = tl.load(low + channel), tl.load(high + channel)
        value = tl.where(value > highest, highest, value)
        value = tl.where(value < lowest, lowest, value)
        tl.store(seen + row + channel, (value - tl.load(mean + channel)) / tl.load(deviation + channel), mask=active)


@triton.jit(do_not_specialize=SIZES)
def fill_state(sums, solid, per_scene, walls, gravity, low, high, mean, deviation, state, seen, share, particle,
               channels, size, MATERIALS: tl.constexpr, SOLID: tl.constexpr, CONSTANTS: tl.constexpr,
               OBSTACLES: tl.constexpr, SEEN: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Fill in the grid state (B size, channels) from the sums of `scatter`.

    Args:
        sums: (B size, 3 M).
        solid: (B, size) share of each cell that is wall or obstacle, with scenes `per_scene` apart; if SOLID.
        walls: (size,) share of each cell that is wall.
        gravity: (B, 2), if CONSTANTS.
        low, high, mean, deviation: (channels,) statistics of the network's input.
        state: (B size, channels), is filled; if SEEN, `seen` likewise with what the network sees.
        share: (B size,), is filled if OBSTACLES: share of each cell's room that is obstacle.
        particle: Volume of a particle, as a share of a cell.
    """
    scene = tl.program_id(1).to(tl.int64)
    node = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = node < size
    cell = scene * size + node
    row, total = cell * channels, sums + cell * (3 * MATERIALS)
    for kind in tl.static_range(MATERIALS):
        count = tl.load(total + 2 * MATERIALS + kind, mask=active, other=0.0)
        divisor = tl.where(count > LEAST, count, 1.0)
        for axis in tl.static_range(2):
            value = tl.load(total + 2 * kind + axis, mask=active, other=0.0) / divisor
            _fill(state, seen, low, high, mean, deviation, row, 2 * kind + axis, value, active, SEEN)
        filled = count * particle
        _fill(state, seen, low, high, mean, deviation, row, 2 * MATERIALS + kind, filled, active, SEEN)
    if SOLID:
        taken = tl.load(solid + scene * per_scene + node, mask=active, other=0.0)
        _fill(state, seen, low, high, mean, deviation, row, 3 * MATERIALS, taken, active, SEEN)
        if OBSTACLES:
            wall = tl.load(walls + node, mask=active, other=0.0)
            part = tl.minimum(tl.maximum((taken - wall) / tl.maximum(1 - wall, 1e-6), 0.0), 1.0)
            tl.store(share + cell, tl.where(wall < 1, part, 0.0), mask=active)
    if CONSTANTS:
        pull_x = tl.load(gravity + 2 * scene) + tl.zeros((BLOCK,), tl.float32)
        pull_y = tl.load(gravity + 2 * scene + 1) + tl.zeros((BLOCK,), tl.float32)
        _fill(state, seen, low, high, mean, deviation, row, 3 * MATERIALS + SOLID, pull_x, active, SEEN)
        _fill(state, seen, low, high, mean, deviation, row, 3 * MATERIALS + SOLID + 1, pull_y, active, SEEN)
