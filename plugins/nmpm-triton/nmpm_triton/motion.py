"""Kernels that move particles through a bundle, in Triton: what the torch engine's `advection` computes.

Paths are (B, m + 1, N, 2) in cells; their first frame is the start. Of particles there are `volume` (B, N), multiples
of the scene's, and `weight` (B, N), shares of the scene's mass, 0 for padding; of scenes `gravity` (B, 2). A program
treats a block of particles in the scene `program_id(1)`. What all of a scene's particles decide together is summed in
one program where that has all of them; else block by block, and the blocks' sums by each program that needs them: in a
fixed order, and without waiting within a launch.
"""

import triton
import triton.language as tl

from nmpm_triton.grid import SIZES, interpolate, load_kind

SUMS = tl.constexpr(5)
"""Of each block and frame: what gravity's potential would give if nobody moved; kinetic energy of the particles that
gain energy, and of all; the same two of the work of gravity."""


@triton.jit
def load(path, row, active):
    """Both coordinates."""
    return tl.load(path + 2 * row, mask=active, other=0.0), tl.load(path + 2 * row + 1, mask=active, other=0.0)


@triton.jit
def store(path, row, x, y, active):
    """Both coordinates."""
    tl.store(path + 2 * row, x, mask=active)
    tl.store(path + 2 * row + 1, y, mask=active)


@triton.jit
def load_masses(volume, material, row, active, BLOCK: tl.constexpr, MASSES: tl.constexpr):
    """Shares of the scene's mass, of which all particles are in the block; MASSES are those of equal volumes."""
    mass = tl.load(volume + row, mask=active, other=0).to(tl.float32)
    if len(MASSES) > 1:
        kind = load_kind(material, row, active, BLOCK, len(MASSES))
        for each in tl.static_range(len(MASSES)):
            mass = tl.where(kind == each, mass * MASSES[each], mass)
    total = tl.sum(mass, 0)
    return mass / tl.where(total > 0, total, 1.0)


@triton.jit
def confine(x, lowest, highest):
    """A coordinate within the bounds; NaN stays."""
    x = tl.where(x > highest, highest, x)
    return tl.where(x < lowest, lowest, x)


@triton.jit
def _balance(x, y, u, v, last_u, last_v, pull_x, pull_y, ratio):
    """Of steps (u, v): kinetic energy, work of gravity, minus the potential before, and whether energy is gained.

    In widths of the first axis' cells, of which the second's are `ratio`; a gain is more than rounding.
    """
    y, v, last_v, pull_y = y * ratio, v * ratio, last_v * ratio, pull_y * ratio
    gain = (u - last_u) * (u + last_u) / 2 - u * pull_x - 4.76837158203125e-07 * tl.abs(x * u)
    gain += (v - last_v) * (v + last_v) / 2 - v * pull_y - 4.76837158203125e-07 * tl.abs(y * v)
    return (u * u + v * v) / 2, u * pull_x + v * pull_y, x * pull_x + y * pull_y, gain > 0


@triton.jit
def _largest_root(square, slope, constant):
    """Largest s with square · s² + slope · s + constant = 0, and whether there is one; else where that is lowest."""
    inner = slope * slope - 4 * square * constant
    moves = square > 1.0842021724855044e-19
    root = (tl.sqrt(tl.maximum(inner, 1.1754943508222875e-38)) - slope) / tl.where(moves, 2 * square, 1.0)
    return root, moves & (inner >= 0)


@triton.jit
def _factors(height, kinetic_gained, kinetic, fall_gained, fall, budget):
    """Factors for the steps of those that gain energy in a frame, and of the others; 1 where they are not needed."""
    excess = tl.maximum(-height - budget, -1e18)
    rest = excess + (kinetic - fall - kinetic_gained + fall_gained)
    factor, exact = _largest_root(kinetic_gained, -fall_gained, rest)
    suffices = exact & (factor >= 0) & (factor <= 1)
    of_all, _ = _largest_root(kinetic, -fall, excess)
    of_all = tl.minimum(tl.maximum(of_all, 0.0), 1.0)
    exceeds = kinetic - fall + excess > 0
    of_gainers, of_others = tl.where(suffices, factor, of_all), tl.where(suffices, 1.0, of_all)
    return tl.where(exceeds, of_gainers, 1.0), tl.where(exceeds, of_others, 1.0)


@triton.jit
def _total(sums, column, tiles, TILES: tl.constexpr):
    """A sum over a scene's blocks of one of `SUMS`."""
    tile = tl.arange(0, TILES)
    return tl.sum(tl.load(sums + tile * SUMS + column, mask=tile < tiles, other=0.0), 0)


@triton.jit
def carry(u, v, x, y, state, kind, channels, active, nx, ny, WX: tl.constexpr, WY: tl.constexpr, OWN: tl.constexpr,
          GRID: tl.constexpr):  # fmt: skip
    """The velocities that particles keep, of their own (u, v) and of a scene's grid state (size, channels)."""
    kept_u, kept_v = tl.zeros_like(u), tl.zeros_like(v)  # shares of zero would make NaN of infinite velocities
    if OWN != 0:
        kept_u, kept_v = OWN * u, OWN * v
    if GRID != 0:
        seen, row = state + 2 * kind, ny * channels
        kept_u += GRID * interpolate(seen, x, y, row, channels, active, nx, ny, WX, WY)
        kept_v += GRID * interpolate(seen + 1, x, y, row, channels, active, nx, ny, WX, WY)
    return kept_u, kept_v


@triton.jit
def propose(x, y, kept_u, kept_v, pull_x, pull_y, output, scale, kind, frame, outputs, per_frame, per_channel, per_row,
            per_column, left, right, down, up, active, nx, ny, WX: tl.constexpr, WY: tl.constexpr, FALL: tl.constexpr,
            KEEPS: tl.constexpr):  # fmt: skip
    """Places after a frame, by the scene's output (m, C, *S) times `scale` (m, C), within the bounds."""
    own, factor = output + frame * per_frame + 2 * kind * per_channel, scale + frame * outputs + 2 * kind
    u = interpolate(own, x, y, per_row, per_column, active, nx, ny, WX, WY)
    v = interpolate(own + per_channel, x, y, per_row, per_column, active, nx, ny, WX, WY)
    u, v = u * tl.load(factor, mask=active, other=0.0), v * tl.load(factor + 1, mask=active, other=0.0)
    if FALL != 0:
        falls = FALL
        if not KEEPS:
            falls = FALL * (frame + 1)
        kept_u, kept_v = kept_u + pull_x * falls, kept_v + pull_y * falls
    return confine(x + (kept_u + u), left, right), confine(y + (kept_v + v), down, up)


@triton.jit
def load_bounds(bounds, per_end, per_axis, WALLS_X: tl.constexpr, WALLS_Y: tl.constexpr):
    """Lowest and highest places along the axes, of `bounds` (2, 2); infinite along an axis without walls."""
    left, right, down, up = float("-inf"), float("inf"), float("-inf"), float("inf")
    if WALLS_X:
        left, right = tl.load(bounds), tl.load(bounds + per_end)
    if WALLS_Y:
        down, up = tl.load(bounds + per_axis), tl.load(bounds + per_end + per_axis)
    return left, right, down, up


@triton.jit(do_not_specialize=SIZES)
def flight(
    cells, velocity, material, volume, gravity, state, output, scale, budget, bounds, path, squares, frames, count,
    cells_apart, path_apart, channels, outputs, per_scene, per_frame, per_channel, per_row, per_column, per_end,
    per_axis, ratio, nx, ny, WX: tl.constexpr, WY: tl.constexpr, WALLS_X: tl.constexpr, WALLS_Y: tl.constexpr,
    MATERIALS: tl.constexpr, OWN: tl.constexpr, GRID: tl.constexpr, FALL: tl.constexpr, KEEPS: tl.constexpr,
    LIMITED: tl.constexpr, MASSES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Move particles through all frames; if LIMITED, within their scene's energy, and a scene is one program's.

    Args:
        cells, velocity: (B, N, 2); with `material` and `volume` (B, N), `gravity`, and if LIMITED `budget` (B,).
        path: (B, m, N, 2) without the start, is filled; its scenes, and those of cells, are `…_apart` particles apart.
        state: (B size, channels).
        output: (B, m, C, *S), of the network, whose strides are `per_…`; C is `outputs`.
        scale: (m, C), of the output.
        bounds: (2, 2) lowest and highest places, with strides `per_end` and `per_axis`.
        squares: (B, programs), is filled: the longest step's square.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, particle = p < count, scene * count + p
    kind = load_kind(material, particle, active, BLOCK, MATERIALS)
    kind = tl.minimum(tl.maximum(kind, 0), MATERIALS - 1)
    pull_x, pull_y = tl.load(gravity + 2 * scene), tl.load(gravity + 2 * scene + 1)
    left, right, down, up = load_bounds(bounds, per_end, per_axis, WALLS_X, WALLS_Y)
    share = tl.load(volume + particle, mask=active, other=0).to(tl.float32)
    if LIMITED:
        share = load_masses(volume, material, particle, active, BLOCK, MASSES)
    x, y = load(cells, scene * cells_apart + p, active)
    u, v = load(velocity, particle, active)
    seen = state + scene * (nx * ny * channels)
    kept_u, kept_v = carry(u, v, x, y, seen, kind, channels, active, nx, ny, WX, WY, OWN, GRID)
    longest = tl.zeros((BLOCK,), tl.float32)
    for frame in range(frames):
        next_x, next_y = propose(x, y, kept_u, kept_v, pull_x, pull_y, output + scene * per_scene, scale, kind, frame,
                                 outputs, per_frame, per_channel, per_row, per_column, left, right, down, up, active,
                                 nx, ny, WX, WY, FALL, KEEPS)  # fmt: skip
        if LIMITED:
            kinetic, fall, height, gains = _balance(x, y, next_x - x, next_y - y, u, v, pull_x, pull_y, ratio)
            gaining, real = (share > 0) & gains, share > 0
            of_gainers, of_others = _factors(
                tl.sum(tl.where(real, share * height, 0.0), 0), tl.sum(tl.where(gaining, share * kinetic, 0.0), 0),
                tl.sum(tl.where(real, share * kinetic, 0.0), 0), tl.sum(tl.where(gaining, share * fall, 0.0), 0),
                tl.sum(tl.where(real, share * fall, 0.0), 0), tl.load(budget + scene),
            )  # fmt: skip
            factor = tl.where(gains, of_gainers, of_others)
            next_x = tl.where(factor < 1, confine(x + factor * (next_x - x), left, right), next_x)
            next_y = tl.where(factor < 1, confine(y + factor * (next_y - y), down, up), next_y)
        u, v = next_x - x, next_y - y
        if KEEPS:
            kept_u, kept_v = u, v
        square = u * u + v * v
        longest = tl.maximum(longest, tl.where((share > 0) & (square < float("inf")), square, 0.0))
        x, y = next_x, next_y
        store(path, scene * path_apart + frame * count + p, x, y, active)
    tl.store(squares + scene * tl.num_programs(0) + tl.program_id(0), tl.max(longest, 0))


@triton.jit(do_not_specialize=SIZES)
def advance(
    velocity, material, weight, gravity, state, output, scale, budget, bounds, carried, path, sums, squares,
    frame, frames, count, tiles, channels, outputs, per_scene, per_frame, per_channel, per_row, per_column, per_end,
    per_axis, ratio, nx, ny, WX: tl.constexpr, WY: tl.constexpr, WALLS_X: tl.constexpr, WALLS_Y: tl.constexpr,
    MATERIALS: tl.constexpr,
    OWN: tl.constexpr, GRID: tl.constexpr, FALL: tl.constexpr, KEEPS: tl.constexpr, FIRST: tl.constexpr,
    LAST: tl.constexpr, BLOCK: tl.constexpr, TILES: tl.constexpr,
):  # fmt: skip
    """`flight` frame by frame, for scenes of more particles than a program takes, within their energy.

    Shortens `frame` of the path to the scene's energy, and proposes the next one; FIRST: starts; LAST: proposes none.

    Args:
        velocity, material, gravity, state, output, scale, budget, bounds: As of `flight`; with `weight`.
        carried: (B, N, 2), the velocities that particles keep.
        path: (B, m + 1, N, 2) with the start, whose frames up to `frame` are final then.
        sums: (B, m, tiles, SUMS).
        squares: (B, m, tiles), of the longest step in each frame.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, particle = p < count, scene * count + p
    begin, tile = scene * (frames + 1) * count + p, scene * frames * tiles + tl.program_id(0)
    share = tl.load(weight + particle, mask=active, other=0.0)
    kind = load_kind(material, particle, active, BLOCK, MATERIALS)
    kind = tl.minimum(tl.maximum(kind, 0), MATERIALS - 1)
    pull_x, pull_y = tl.load(gravity + 2 * scene), tl.load(gravity + 2 * scene + 1)
    left, right, down, up = load_bounds(bounds, per_end, per_axis, WALLS_X, WALLS_Y)
    u, v = load(velocity, particle, active)
    if FIRST:
        x, y = load(path, begin, active)
        seen = state + scene * (nx * ny * channels)
        kept_u, kept_v = carry(u, v, x, y, seen, kind, channels, active, nx, ny, WX, WY, OWN, GRID)
        store(carried, particle, kept_u, kept_v, active)
    else:
        before_x, before_y = load(path, begin + (frame - 1) * count, active)
        x, y = load(path, begin + frame * count, active)
        older_x, older_y = load(path, begin + tl.maximum(frame - 2, 0) * count, active)
        step_x, step_y = x - before_x, y - before_y
        proposed = sums + (scene * frames + frame - 1) * tiles * SUMS
        of_gainers, of_others = _factors(
            _total(proposed, 0, tiles, TILES), _total(proposed, 1, tiles, TILES), _total(proposed, 2, tiles, TILES),
            _total(proposed, 3, tiles, TILES), _total(proposed, 4, tiles, TILES), tl.load(budget + scene),
        )  # fmt: skip
        fresh = tl.where(frame > 1, 0.0, 1.0)  # of the first step, older places are those before it
        last_u, last_v = before_x - older_x + fresh * u, before_y - older_y + fresh * v
        _, _, _, gains = _balance(before_x, before_y, step_x, step_y, last_u, last_v, pull_x, pull_y, ratio)
        factor = tl.where(gains, of_gainers, of_others)
        x = tl.where(factor < 1, confine(before_x + factor * step_x, left, right), x)
        y = tl.where(factor < 1, confine(before_y + factor * step_y, down, up), y)
        store(path, begin + frame * count, x, y, active)
        u, v = x - before_x, y - before_y
        square = u * u + v * v
        longest = tl.max(tl.where((share > 0) & (square < float("inf")), square, 0.0), 0)
        tl.store(squares + tile + (frame - 1) * tiles, longest)
        kept_u, kept_v = u, v
        if (not KEEPS) and (not LAST):
            kept_u, kept_v = load(carried, particle, active)
    if not LAST:
        next_x, next_y = propose(x, y, kept_u, kept_v, pull_x, pull_y, output + scene * per_scene, scale, kind, frame,
                                 outputs, per_frame, per_channel, per_row, per_column, left, right, down, up, active,
                                 nx, ny, WX, WY, FALL, KEEPS)  # fmt: skip
        store(path, begin + (frame + 1) * count, next_x, next_y, active)
        kinetic, fall, height, gains = _balance(x, y, next_x - x, next_y - y, u, v, pull_x, pull_y, ratio)
        gaining, target = (share > 0) & gains, sums + (tile + frame * tiles) * SUMS
        tl.store(target, tl.sum(tl.where(share > 0, share * height, 0.0), 0))
        tl.store(target + 1, tl.sum(tl.where(gaining, share * kinetic, 0.0), 0))
        tl.store(target + 2, tl.sum(tl.where(share > 0, share * kinetic, 0.0), 0))
        tl.store(target + 3, tl.sum(tl.where(gaining, share * fall, 0.0), 0))
        tl.store(target + 4, tl.sum(tl.where(share > 0, share * fall, 0.0), 0))


@triton.jit(do_not_specialize=SIZES)
def land(path, step, position, velocity, frames, count, per_scene, low_x, low_y, wide_x, wide_y, BLOCK: tl.constexpr):
    """Fill in positions (B, m, N, 2) and velocities (B, N, 2) in domain length, from a path and the last step in cells.

    The path's scenes are `per_scene` apart.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = p < count
    u, v = load(step, scene * count + p, active)
    store(velocity, scene * count + p, u * wide_x, v * wide_y, active)
    for frame in range(frames):
        x, y = load(path + scene * per_scene, frame * count + p, active)
        store(position, (scene * frames + frame) * count + p, x * wide_x + low_x, y * wide_y + low_y, active)
