"""Gradients of the kernels of `grid` and `motion` in training, in Triton: p2g, and the path within the bounds.

What a kernel adds to a grid is summed by atomics, in no fixed order.
"""

import triton
import triton.language as tl

from nmpm_triton.grid import LEAST, SIZES, find_nodes, load_kind
from nmpm_triton.motion import load, load_bounds, store


@triton.jit
def _slope(x, extent, WRAPS: tl.constexpr):
    """1 where the weights of `find_nodes` change with the place, 0 where they are held at an end of the axis."""
    changes = x == x
    if not WRAPS:
        changes = (x > 0.5) & (x < extent - 0.5)
    return tl.where(changes, 1.0, 0.0)


@triton.jit
def _corner(values, node, to_u, to_v, channel, active):
    """The gradient with respect to a node's weight, from that with respect to the interpolated velocity."""
    u = tl.load(values + node, mask=active, other=0.0).to(tl.float32)
    return to_u * u + to_v * tl.load(values + node + channel, mask=active, other=0.0).to(tl.float32)


@triton.jit
def _add(gradient, node, weight, to_u, to_v, active):
    tl.atomic_add(gradient + node, weight * to_u, mask=active, sem="relaxed")
    tl.atomic_add(gradient + node + 1, weight * to_v, mask=active, sem="relaxed")


@triton.jit
def _interpolate_back(values, gradient, x, y, to_u, to_v, row, column, channel, columns, active, nx, ny,
                      WX: tl.constexpr, WY: tl.constexpr):  # fmt: skip
    """Gradients with respect to places, from those with respect to both values of `interpolate` there.

    Those with respect to the values are added to `gradient` (size, columns).
    """
    i0, i1, a = find_nodes(x, nx, WX)
    j0, j1, b = find_nodes(y, ny, WY)
    low, high = (
        _corner(values, i0 * row + j0 * column, to_u, to_v, channel, active),
        _corner(values, i0 * row + j1 * column, to_u, to_v, channel, active),
    )
    next_low, next_high = (
        _corner(values, i1 * row + j0 * column, to_u, to_v, channel, active),
        _corner(values, i1 * row + j1 * column, to_u, to_v, channel, active),
    )
    _add(gradient, (i0 * ny + j0) * columns, (1 - a) * (1 - b), to_u, to_v, active)
    _add(gradient, (i0 * ny + j1) * columns, (1 - a) * b, to_u, to_v, active)
    _add(gradient, (i1 * ny + j0) * columns, a * (1 - b), to_u, to_v, active)
    _add(gradient, (i1 * ny + j1) * columns, a * b, to_u, to_v, active)
    along_x = (1 - b) * (next_low - low) + b * (next_high - high)
    along_y = (1 - a) * (high - low) + a * (next_high - next_low)
    return _slope(x, nx, WX) * along_x, _slope(y, ny, WY) * along_y


@triton.jit(do_not_specialize=SIZES)
def flight_back(
    cells, material, volume, state, output, scale, bounds, path, grad_path, grad_cells, grad_velocity, grad_state,
    grad_output, frames, count, channels, outputs, per_scene, per_frame, per_channel, per_row, per_column, per_end,
    per_axis, nx, ny, WX: tl.constexpr, WY: tl.constexpr, WALLS_X: tl.constexpr, WALLS_Y: tl.constexpr,
    MATERIALS: tl.constexpr, OWN: tl.constexpr, GRID: tl.constexpr, KEEPS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of `motion.flight` without energy, from those with respect to its path.

    A place stopped at a bound, or of padding, passes none.

    Args:
        cells, material, volume, state, output, scale, bounds: As there.
        path, grad_path: (B, m, N, 2).
        grad_cells, grad_velocity: (B, N, 2), are filled.
        grad_state: (B size, channels), is added to, if GRID is not 0.
        grad_output: (B, m, size, C), is added to.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, particle = p < count, scene * count + p
    real = active & (tl.load(volume + particle, mask=active, other=0).to(tl.float32) > 0)
    kind = load_kind(material, particle, active, BLOCK, MATERIALS)
    kind = tl.minimum(tl.maximum(kind, 0), MATERIALS - 1)
    left, right, down, up = load_bounds(bounds, per_end, per_axis, WALLS_X, WALLS_Y)
    start_x, start_y = load(cells, particle, active)
    none = tl.zeros((BLOCK,), tl.float32)
    to_x, to_y, older_x, older_y, kept_u, kept_v = none, none, none, none, none, none  # places now, before; velocities
    for back in range(frames):
        frame = frames - 1 - back
        here = (scene * frames + frame) * count + p
        x, y = load(path, here, active)
        grad_x, grad_y = load(grad_path, here, active)
        grad_x = tl.where(real & (x > left) & (x < right), grad_x + to_x, 0.0)
        grad_y = tl.where(real & (y > down) & (y < up), grad_y + to_y, 0.0)
        before = here - tl.minimum(frame, 1) * count
        first = tl.where(frame > 0, 0.0, 1.0)
        x, y = load(path, before, active)
        x, y = tl.where(frame > 0, x, start_x), tl.where(frame > 0, y, start_y)
        factor = scale + frame * outputs + 2 * kind
        to_u = grad_x * tl.load(factor, mask=active, other=0.0)
        to_v = grad_y * tl.load(factor + 1, mask=active, other=0.0)
        along_x, along_y = _interpolate_back(
            output + scene * per_scene + frame * per_frame + 2 * kind * per_channel,
            grad_output + (scene * frames + frame) * (nx * ny) * outputs + 2 * kind, x, y, to_u, to_v, per_row,
            per_column, per_channel, outputs, real, nx, ny, WX, WY,
        )  # fmt: skip
        to_x, to_y = older_x + grad_x + along_x, older_y + grad_y + along_y
        if KEEPS:  # the velocity of the frame before is a difference of places
            kept_u, kept_v = first * grad_x, first * grad_y
            to_x, to_y = to_x + (1 - first) * grad_x, to_y + (1 - first) * grad_y
            older_x, older_y = (first - 1) * grad_x, (first - 1) * grad_y
        else:
            kept_u, kept_v = kept_u + grad_x, kept_v + grad_y
    if GRID != 0:
        along_x, along_y = _interpolate_back(
            state + scene * (nx * ny) * channels + 2 * kind, grad_state + scene * (nx * ny) * channels + 2 * kind,
            start_x, start_y, GRID * kept_u, GRID * kept_v, ny * channels, channels, 1, channels, real, nx, ny, WX, WY,
        )  # fmt: skip
        to_x, to_y = to_x + along_x, to_y + along_y
    store(grad_cells, particle, to_x, to_y, active)
    store(grad_velocity, particle, OWN * kept_u, OWN * kept_v, active)


@triton.jit
def _corner_back(state, gradient, node, kind, u, v, weight, particle, channels, active, MATERIALS: tl.constexpr):
    """Gradients of a node's channels with respect to a particle's velocity, times its weight, and to the weight.

    A mean changes with a weight by (value - mean) / number: taken apart, two large numbers would cancel each other
    where the number is small.
    """
    row, volume = node * channels + 2 * kind, node * channels + 2 * MATERIALS + kind
    number = tl.load(state + volume, mask=active, other=0.0) / particle
    inverse = 1 / tl.where(number > LEAST, number, 1.0)
    to_u = tl.load(gradient + row, mask=active, other=0.0) * inverse
    to_v = tl.load(gradient + row + 1, mask=active, other=0.0) * inverse
    slope = tl.load(gradient + volume, mask=active, other=0.0) * particle
    slope += to_u * (u - tl.load(state + row, mask=active, other=0.0))
    slope += to_v * (v - tl.load(state + row + 1, mask=active, other=0.0))
    return weight * to_u, weight * to_v, slope


@triton.jit(do_not_specialize=SIZES)
def rasterise_back(cells, velocity, material, volume, state, grad_state, grad_cells, grad_velocity, count, channels,
                   particle, nx, ny, WX: tl.constexpr, WY: tl.constexpr, MATERIALS: tl.constexpr,
                   BLOCK: tl.constexpr):  # fmt: skip
    """Gradients of the grid state with respect to places and velocities in cells.

    Args:
        cells, velocity: (B, N, 2); with `material` and `volume` (B, N).
        state, grad_state: (B size, channels).
        grad_cells, grad_velocity: (B, N, 2), are filled.
        particle: Volume of a particle, as a share of a cell.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < count, scene * count + p
    share = tl.load(volume + row, mask=inside, other=0).to(tl.float32)
    kind = load_kind(material, row, inside, BLOCK, MATERIALS)
    active = inside & (share > 0) & (kind >= 0) & (kind < MATERIALS)
    x, y = load(cells, row, inside)
    u, v = load(velocity, row, inside)
    i0, i1, a = find_nodes(x, nx, WX)
    j0, j1, b = find_nodes(y, ny, WY)
    first = scene * (nx * ny) * channels
    seen, back = state + first, grad_state + first
    u00, v00, low = _corner_back(
        seen, back, i0 * ny + j0, kind, u, v, (1 - a) * (1 - b), particle, channels, active, MATERIALS
    )
    u01, v01, high = _corner_back(
        seen, back, i0 * ny + j1, kind, u, v, (1 - a) * b, particle, channels, active, MATERIALS
    )
    u10, v10, next_low = _corner_back(
        seen, back, i1 * ny + j0, kind, u, v, a * (1 - b), particle, channels, active, MATERIALS
    )
    u11, v11, next_high = _corner_back(
        seen, back, i1 * ny + j1, kind, u, v, a * b, particle, channels, active, MATERIALS
    )
    along_x = _slope(x, nx, WX) * ((1 - b) * (next_low - low) + b * (next_high - high))
    along_y = _slope(y, ny, WY) * ((1 - a) * (high - low) + a * (next_high - next_low))
    along_x, along_y = tl.where(active, share * along_x, 0.0), tl.where(active, share * along_y, 0.0)
    store(grad_cells, row, along_x, along_y, inside)
    to_u, to_v = share * (u00 + u01 + u10 + u11), share * (v00 + v01 + v10 + v11)
    store(grad_velocity, row, tl.where(active, to_u, 0.0), tl.where(active, to_v, 0.0), inside)
