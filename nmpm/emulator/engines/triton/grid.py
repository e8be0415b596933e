"""Kernels between particles and grid, in Triton: what `nmpm.emulator.rasterise` and `support` compute.

Particles are rows (B N, 2), nodes rows (B size, channels), the last axis of the grid fastest; a program treats a block
of them in the scene `program_id(1)`. The grid has (nx, ny) nodes; all is in cells. Names in capitals are known when a
kernel is compiled: which axes wrap, the number of materials, what a model has.
"""

import triton
import triton.language as tl

SIZES = ("nx", "ny", "count", "tiles", "frame", "frames", "per_scene", "per_frame", "per_channel", "per_row")
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


@triton.jit(do_not_specialize=SIZES)
def scatter(cells, velocity, material, mask, sums, count, nx, ny, WX: tl.constexpr, WY: tl.constexpr,
            MATERIALS: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Add momenta and numbers of particles to `sums` (B size, 2 M + M) of each material."""
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < count, scene * count + p
    active = inside & (tl.load(mask + row, mask=inside, other=0) != 0)
    u, v = tl.load(velocity + 2 * row, mask=inside, other=0.0), tl.load(velocity + 2 * row + 1, mask=inside, other=0.0)
    kind = tl.zeros((BLOCK,), tl.int32)
    if MATERIALS > 1:
        kind = tl.load(material + row, mask=inside, other=0).to(tl.int32)
        active = active & (kind >= 0) & (kind < MATERIALS)
    i0, i1, a = find_nodes(tl.load(cells + 2 * row, mask=inside, other=0.0), nx, WX)
    j0, j1, b = find_nodes(tl.load(cells + 2 * row + 1, mask=inside, other=0.0), ny, WY)
    nodes = sums + scene * (nx * ny * 3 * MATERIALS)
    _add(nodes, i0 * ny + j0, (1 - a) * (1 - b), u, v, kind, active, MATERIALS)
    _add(nodes, i0 * ny + j1, (1 - a) * b, u, v, kind, active, MATERIALS)
    _add(nodes, i1 * ny + j0, a * (1 - b), u, v, kind, active, MATERIALS)
    _add(nodes, i1 * ny + j1, a * b, u, v, kind, active, MATERIALS)


@triton.jit
def _filled(filled, column, row, extent, across, stride, side, period, ENOUGH: tl.constexpr):
    """Whether there is so much material in a cell; columns around the end are `period` away, 0 where none wrap."""
    column = tl.where(column < 0, column + period, column)
    column = tl.where(column >= across, column - period, column)
    inside = (column >= 0) & (column < across) & (row >= 0) & (row < extent)
    return tl.load(filled + row * stride + column * side, mask=inside, other=0.0) >= ENOUGH


@triton.jit
def _bears(filled, share, column, row, lowest, up, floor, extent, across, stride, side, period,
           OBSTACLES: tl.constexpr, ENOUGH: tl.constexpr, SURFACE: tl.constexpr):  # fmt: skip
    """Whether cells, `row` up from the lowest, bear what lies on them, and whether they are floor or obstacle."""
    here = lowest + up * row
    bears = _filled(filled, column, here, extent, across, stride, side, period, ENOUGH)
    bears = bears | _filled(filled, column - 1, here, extent, across, stride, side, period, ENOUGH)
    bears = bears | _filled(filled, column + 1, here, extent, across, stride, side, period, ENOUGH)
    base = (row < floor) & (column < across)
    if OBSTACLES:
        inside = (column < across) & (row >= 0) & (row < extent)
        base = base | (tl.load(share + here * stride + column * side, mask=inside, other=0.0) >= SURFACE)
    return bears | base, base


@triton.jit
def _larger(a, b):
    return tl.maximum(a, b)


@triton.jit(do_not_specialize=SIZES)
def support(filled, share, gravity, held, nx, ny, WX: tl.constexpr, WY: tl.constexpr, LEFT: tl.constexpr,
            RIGHT: tl.constexpr, DOWN: tl.constexpr, UP: tl.constexpr, OBSTACLES: tl.constexpr, REACH: tl.constexpr,
            ENOUGH: tl.constexpr, SURFACE: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr):  # fmt: skip
    """Fill in whether the material in each cell is held up, `held` (B size,) int8: a program treats some columns.

    `filled` and `share` (B size,) are what of each cell is material, and what of its room is obstacle. ROWS is a power
    of two, at least the grid's longest axis; LEFT, RIGHT, DOWN and UP are the rows beyond the bounds at its ends.
    """
    scene = tl.program_id(1).to(tl.int64)
    pull_x, pull_y = tl.load(gravity + 2 * scene), tl.load(gravity + 2 * scene + 1)
    vertical = tl.abs(pull_y) > tl.abs(pull_x)
    extent, across = tl.where(vertical, ny, nx), tl.where(vertical, nx, ny)
    stride, side = tl.where(vertical, 1, ny), tl.where(vertical, ny, 1)
    upwards = tl.where(vertical, pull_y, pull_x) > 0
    lowest, up = tl.where(upwards, extent - 1, 0), tl.where(upwards, -1, 1)
    floor = tl.where(vertical, tl.where(upwards, UP, DOWN), tl.where(upwards, RIGHT, LEFT))
    period = tl.where(vertical, WX * nx, WY * ny)
    bound = tl.where((pull_x == 0) & (pull_y == 0), 0, tl.where(vertical, 1 - WY, 1 - WX))  # 0: all is held
    column = (tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS))[:, None]
    row = tl.arange(0, ROWS)[None, :]
    full, solid = filled + scene * (nx * ny), share + scene * (nx * ny)
    near, base = _bears(full, solid, column, row, lowest, up, floor, extent, across, stride, side, period,
                        OBSTACLES, ENOUGH, SURFACE)  # fmt: skip
    for distance in tl.static_range(1, REACH):
        below, _ = _bears(full, solid, column, row - distance, lowest, up, floor, extent, across, stride, side, period,
                          OBSTACLES, ENOUGH, SURFACE)  # fmt: skip
        near = near | below | (row < distance)
    gap = tl.associative_scan(tl.where(near, 0, (row + 1) * bound), 1, _larger)
    ground = tl.associative_scan(tl.where(base, row + 1, 0), 1, _larger)
    target = held + scene * (nx * ny) + column * side
    above = row + 1  # is held if there is no gap since the last floor or obstacle
    tl.store(target + (lowest + up * above) * stride, (gap <= ground).to(tl.int8),
             mask=(column < across) & (above < extent))  # fmt: skip
    tl.store(target + (lowest + up * row) * stride, tl.full((COLUMNS, ROWS), 1, tl.int8),
             mask=(column < across) & (row == 0))  # fmt: skip
