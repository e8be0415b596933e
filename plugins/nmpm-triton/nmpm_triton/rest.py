"""Kernels that bring particles to rest, in Triton: what the torch engine's `support` and `constraints.at_rest` compute.

Arrays as in `motion`.
"""

import triton
import triton.language as tl

from nmpm_triton.grid import SIZES, interpolate
from nmpm_triton.motion import confine, load, store


@triton.jit
def _filled(filled, channels, column, row, extent, across, stride, side, period, MATERIALS: tl.constexpr,
            ENOUGH: tl.constexpr):  # fmt: skip
    """Whether there is so much material in a cell; columns around the end are `period` away, 0 where none wrap."""
    column = tl.where(column < 0, column + period, column)
    column = tl.where(column >= across, column - period, column)
    inside = (column >= 0) & (column < across) & (row >= 0) & (row < extent)
    node = filled + (row * stride + column * side) * channels
    volume = tl.load(node, mask=inside, other=0.0)
    for kind in tl.static_range(1, MATERIALS):
        volume += tl.load(node + kind, mask=inside, other=0.0)
    return volume >= ENOUGH


@triton.jit
def _bears(filled, share, channels, column, row, lowest, up, floor, extent, across, stride, side, period,
           MATERIALS: tl.constexpr, OBSTACLES: tl.constexpr, ENOUGH: tl.constexpr,
           SURFACE: tl.constexpr):  # fmt: skip
    """Whether cells, `row` up from the lowest, bear what lies on them, and whether they are floor or obstacle."""
    here = lowest + up * row
    bears = _filled(filled, channels, column, here, extent, across, stride, side, period, MATERIALS, ENOUGH)
    bears = bears | _filled(filled, channels, column - 1, here, extent, across, stride, side, period, MATERIALS, ENOUGH)
    bears = bears | _filled(filled, channels, column + 1, here, extent, across, stride, side, period, MATERIALS, ENOUGH)
    base = (row < floor) & (column < across)
    if OBSTACLES:
        inside = (column < across) & (row >= 0) & (row < extent)
        base = base | (tl.load(share + here * stride + column * side, mask=inside, other=0.0) >= SURFACE)
    return bears | base, base


@triton.jit
def _larger(a, b):
    return tl.maximum(a, b)


@triton.jit(do_not_specialize=SIZES)
def support(state, share, gravity, held, channels, nx, ny, WX: tl.constexpr, WY: tl.constexpr, LEFT: tl.constexpr,
            RIGHT: tl.constexpr, DOWN: tl.constexpr, UP: tl.constexpr, MATERIALS: tl.constexpr, OBSTACLES: tl.constexpr,
            REACH: tl.constexpr, ENOUGH: tl.constexpr, SURFACE: tl.constexpr, ROWS: tl.constexpr,
            COLUMNS: tl.constexpr):  # fmt: skip
    """Fill in whether the material in each cell is held up, `held` (B size,) int8: a program treats some columns.

    From the grid state (B size, channels) and the `share` (B size,) of each cell's room that is obstacle. ROWS is a
    power of two, at least the grid's longest axis; LEFT, RIGHT, DOWN and UP are the rows beyond the bounds at its ends.
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
    full, solid = state + scene * (nx * ny * channels) + 2 * MATERIALS, share + scene * (nx * ny)
    near, base = _bears(full, solid, channels, column, row, lowest, up, floor, extent, across, stride, side, period,
                        MATERIALS, OBSTACLES, ENOUGH, SURFACE)  # fmt: skip
    for distance in tl.static_range(1, REACH):
        below, _ = _bears(full, solid, channels, column, row - distance, lowest, up, floor, extent, across, stride,
                          side, period, MATERIALS, OBSTACLES, ENOUGH, SURFACE)  # fmt: skip
        near = near | below | (row < distance)
    gap = tl.associative_scan(tl.where(near, 0, (row + 1) * bound), 1, _larger)
    ground = tl.associative_scan(tl.where(base, row + 1, 0), 1, _larger)
    target = held + scene * (nx * ny) + column * side
    above = row + 1  # is held if there is no gap since the last floor or obstacle
    tl.store(target + (lowest + up * above) * stride, (gap <= ground).to(tl.int8),
             mask=(column < across) & (above < extent))  # fmt: skip
    tl.store(target + (lowest + up * row) * stride, tl.full((COLUMNS, ROWS), 1, tl.int8),
             mask=(column < across) & (row == 0))  # fmt: skip


@triton.jit
def _cell(x, extent, WRAPS: tl.constexpr):
    """The index of the cell that a place is in."""
    index = tl.floor(tl.where(tl.abs(x) < 1e9, x, 0.0)).to(tl.int32)
    if WRAPS:
        index = ((index % extent) + extent) % extent
    return tl.minimum(tl.maximum(index, 0), extent - 1)


@triton.jit(do_not_specialize=SIZES)
def rest(path, gravity, share, held, frames, count, left, right, down, up, rest_speed, nx, ny, WX: tl.constexpr,
         WY: tl.constexpr, OBSTACLES: tl.constexpr, SURFACE: tl.constexpr, FREE_FALL: tl.constexpr, DROP: tl.constexpr,
         BLOCK: tl.constexpr):  # fmt: skip
    """Stop particles that move too little: they stay where `held` (B size,) is 1, and fall elsewhere.

    None falls into obstacles, of which `share` (B size,) is each cell's.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, begin = p < count, scene * (frames + 1) * count + p
    pull_x, pull_y = tl.load(gravity + 2 * scene), tl.load(gravity + 2 * scene + 1)
    early = tl.maximum(frames // 2, 1)
    late = tl.maximum(frames - early, 1)
    start_x, start_y = load(path, begin, active)
    middle_x, middle_y = load(path, begin + early * count, active)
    end_x, end_y = load(path, begin + frames * count, active)
    moved = tl.sqrt((end_x - start_x) * (end_x - start_x) + (end_y - start_y) * (end_y - start_y))
    gained = ((end_x - middle_x) / late - (middle_x - start_x) / early) * pull_x
    gained += ((end_y - middle_y) / late - (middle_y - start_y) / early) * pull_y
    square = pull_x * pull_x + pull_y * pull_y
    free_fall = tl.where(frames > 1, FREE_FALL * frames / 2 * square, float("inf"))
    still = (moved < rest_speed * frames) & ((gained > free_fall) == 0)
    node = scene * (nx * ny) + _cell(start_x, nx, WX) * ny + _cell(start_y, ny, WY)
    falls = tl.load(held + node, mask=active, other=1) == 0
    steps = frames * (frames + 1) / 2
    factor = DROP / tl.maximum(steps * tl.sqrt(square), DROP)
    drop_x, drop_y = pull_x * factor, pull_y * factor
    if OBSTACLES:
        solid, low_x, low_y = share + scene * (nx * ny), start_x + drop_x * steps, start_y + drop_y * steps
        falls = falls & ((interpolate(solid, low_x, low_y, ny, 1, active, nx, ny, WX, WY) > SURFACE) == 0)
    for frame in range(1, frames + 1):
        fallen = frame * (frame + 1) / 2
        x = tl.where(falls, confine(start_x + drop_x * fallen, left, right), start_x)
        y = tl.where(falls, confine(start_y + drop_y * fallen, down, up), start_y)
        store(path, begin + frame * count, x, y, active & still)
