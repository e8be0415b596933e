"""Kernels that move particles through a bundle, in Triton: what the torch engine's `advection` computes.

Paths are (B, m + 1, N, 2) in cells; their first frame is the start. Of particles there are `weight` (B, N), shares of
the scene's mass, 0 for padding; of scenes `gravity` (B, 2). A program treats a block of particles in the scene
`program_id(1)`. What all of a scene's particles decide together is summed block by block, and the blocks' sums by each
program that needs them: in a fixed order, and without waiting within a launch.
"""

import triton
import triton.language as tl

from nmpm.emulator.engines.triton.grid import SIZES, interpolate

SUMS = tl.constexpr(6)
"""Of each block and frame: what gravity's potential would give if nobody moved; kinetic energy of the particles that
gain energy, and of all; the same two of the work of gravity; the square of the longest step."""


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
def _affordable(sums, tiles, budget, TILES: tl.constexpr):
    """Factors for the steps of those that gain energy in a frame, and of the others; 1 where they are not needed."""
    tile = tl.arange(0, TILES)
    here, there = sums + tile * SUMS, tile < tiles
    excess = tl.maximum(-tl.sum(tl.load(here, mask=there, other=0.0), 0) - budget, -1e18)
    kinetic_gained = tl.sum(tl.load(here + 1, mask=there, other=0.0), 0)
    kinetic = tl.sum(tl.load(here + 2, mask=there, other=0.0), 0)
    fall_gained = -tl.sum(tl.load(here + 3, mask=there, other=0.0), 0)
    fall = -tl.sum(tl.load(here + 4, mask=there, other=0.0), 0)
    factor, exact = _largest_root(kinetic_gained, fall_gained, excess + (kinetic + fall - kinetic_gained - fall_gained))
    suffices = exact & (factor >= 0) & (factor <= 1)
    of_all, _ = _largest_root(kinetic, fall, excess)
    of_all = tl.minimum(tl.maximum(of_all, 0.0), 1.0)
    exceeds = kinetic + fall + excess > 0
    of_gainers, of_others = tl.where(suffices, factor, of_all), tl.where(suffices, 1.0, of_all)
    return tl.where(exceeds, of_gainers, 1.0), tl.where(exceeds, of_others, 1.0)


@triton.jit(do_not_specialize=SIZES)
def advance(
    cells, velocity, material, weight, gravity, state, fields, budget, carried, path, sums, frame, frames, count, tiles,
    channels, left, right, down, up, ratio, per_scene, per_frame, per_channel, per_row, per_column, nx, ny,
    WX: tl.constexpr, WY: tl.constexpr, MATERIALS: tl.constexpr, OWN: tl.constexpr, GRID: tl.constexpr,
    FALL: tl.constexpr, KEEPS: tl.constexpr, LIMITED: tl.constexpr, FIRST: tl.constexpr, LAST: tl.constexpr,
    BLOCK: tl.constexpr, TILES: tl.constexpr,
):  # fmt: skip
    """Shorten `frame` of the path to the scene's energy, and propose the next one; FIRST: start; LAST: propose none.

    Args:
        cells, velocity: (B, N, 2); with `material` (B, N), `weight` and `gravity`.
        state: (B size, channels), which the network has seen.
        fields: (B, m, 2 M, *S), the predicted velocities, which `per_…` are the strides of.
        budget: (B,), energy per mass, used if LIMITED.
        carried: (B, N, 2), the velocities that particles keep.
        path: (B, m + 1, N, 2), whose frames up to `frame` are final then.
        sums: (B, m, tiles, SUMS).
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, particle = p < count, scene * count + p
    begin = scene * (frames + 1) * count + p
    mine = sums + (scene * frames * tiles + tl.program_id(0)) * SUMS
    share = tl.load(weight + particle, mask=active, other=0.0)
    real = share > 0
    kind = tl.zeros((BLOCK,), tl.int32)
    if MATERIALS > 1:
        kind = tl.load(material + particle, mask=active, other=0).to(tl.int32)
        kind = tl.minimum(tl.maximum(kind, 0), MATERIALS - 1)
    pull_x, pull_y = tl.load(gravity + 2 * scene), tl.load(gravity + 2 * scene + 1)
    u, v = load(velocity, particle, active)
    if FIRST:
        x, y = load(cells, particle, active)
        kept_u, kept_v = OWN * u, OWN * v
        if GRID != 0:
            seen, row = state + scene * (nx * ny * channels) + 2 * kind, ny * channels
            kept_u += GRID * interpolate(seen, x, y, row, channels, active, nx, ny, WX, WY)
            kept_v += GRID * interpolate(seen + 1, x, y, row, channels, active, nx, ny, WX, WY)
        store(carried, particle, kept_u, kept_v, active)
        store(path, begin, x, y, active)
    else:
        before_x, before_y = load(path, begin + (frame - 1) * count, active)
        x, y = load(path, begin + frame * count, active)
        older_x, older_y = load(path, begin + tl.maximum(frame - 2, 0) * count, active)
        step_x, step_y = x - before_x, y - before_y
        if LIMITED:
            proposed = sums + (scene * frames + frame - 1) * tiles * SUMS
            of_gainers, of_others = _affordable(proposed, tiles, tl.load(budget + scene), TILES)
            fresh = tl.where(frame > 1, 0.0, 1.0)  # of the first step, older places are those before it
            last_u, last_v = before_x - older_x + fresh * u, before_y - older_y + fresh * v
            _, _, _, gains = _balance(before_x, before_y, step_x, step_y, last_u, last_v, pull_x, pull_y, ratio)
            factor = tl.where(gains, of_gainers, of_others)
            x = tl.where(factor < 1, confine(before_x + factor * step_x, left, right), x)
            y = tl.where(factor < 1, confine(before_y + factor * step_y, down, up), y)
            store(path, begin + frame * count, x, y, active)
        u, v = x - before_x, y - before_y
        square = u * u + v * v
        longest = tl.max(tl.where(real & (square < float("inf")), square, 0.0), 0)
        tl.store(mine + (frame - 1) * tiles * SUMS + 5, longest)
        kept_u, kept_v = u, v
        if (not KEEPS) and (not LAST):
            kept_u, kept_v = load(carried, particle, active)
    if not LAST:
        own_u = fields + scene * per_scene + frame * per_frame + 2 * kind * per_channel
        next_u = interpolate(own_u, x, y, per_row, per_column, active, nx, ny, WX, WY)
        next_v = interpolate(own_u + per_channel, x, y, per_row, per_column, active, nx, ny, WX, WY)
        if FALL != 0:
            falls = FALL
            if not KEEPS:
                falls = FALL * (frame + 1)
            kept_u, kept_v = kept_u + pull_x * falls, kept_v + pull_y * falls
        next_x, next_y = confine(x + (kept_u + next_u), left, right), confine(y + (kept_v + next_v), down, up)
        store(path, begin + (frame + 1) * count, next_x, next_y, active)
        if LIMITED:
            kinetic, fall, height, gains = _balance(x, y, next_x - x, next_y - y, u, v, pull_x, pull_y, ratio)
            target = mine + frame * tiles * SUMS
            tl.store(target, tl.sum(tl.where(real, share * height, 0.0), 0))
            tl.store(target + 1, tl.sum(tl.where(real & gains, share * kinetic, 0.0), 0))
            tl.store(target + 2, tl.sum(tl.where(real, share * kinetic, 0.0), 0))
            tl.store(target + 3, tl.sum(tl.where(real & gains, share * fall, 0.0), 0))
            tl.store(target + 4, tl.sum(tl.where(real, share * fall, 0.0), 0))


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
