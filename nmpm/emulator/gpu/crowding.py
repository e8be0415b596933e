"""Kernels that spread overfull cells, in Triton: what `nmpm.emulator.crowding` computes. Arrays as in `flight`."""

import triton
import triton.language as tl

from nmpm.emulator.gpu.flight import confine, load, store
from nmpm.emulator.gpu.grid import SIZES, find_nodes, interpolate


@triton.jit(do_not_specialize=SIZES)
def count_ends(path, weight, counts, count, frames, nx, ny, WX: tl.constexpr, WY: tl.constexpr, BLOCK: tl.constexpr):
    """Add the numbers of particles at the end of a path (B, m + 1, N, 2) to `counts` (B size,)."""
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = p < count
    active = inside & (tl.load(weight + scene * count + p, mask=inside, other=0.0) > 0)
    row = (scene * (frames + 1) + frames) * count + p
    i0, i1, a = find_nodes(tl.load(path + 2 * row, mask=inside, other=0.0), nx, WX)
    j0, j1, b = find_nodes(tl.load(path + 2 * row + 1, mask=inside, other=0.0), ny, WY)
    own = counts + scene * (nx * ny)
    tl.atomic_add(own + i0 * ny + j0, (1 - a) * (1 - b), mask=active, sem="relaxed")
    tl.atomic_add(own + i0 * ny + j1, (1 - a) * b, mask=active, sem="relaxed")
    tl.atomic_add(own + i1 * ny + j0, a * (1 - b), mask=active, sem="relaxed")
    tl.atomic_add(own + i1 * ny + j1, a * b, mask=active, sem="relaxed")


@triton.jit
def _beside(taken, node, other, is_open, factor, active):
    """Conductance of the faces between nodes and others."""
    here = 1 - tl.load(taken + node, mask=active, other=1.0)
    there = 1 - tl.load(taken + other, mask=active, other=1.0)
    return tl.where(is_open, tl.minimum(here, there) * factor, 0.0)


@triton.jit
def _faces(taken, node, active, factor, nx, ny, WX: tl.constexpr, WY: tl.constexpr):
    """The four nodes beside each, left, right, below and above, and the conductances of the faces to them."""
    i, j = node // ny, node % ny
    left, right = tl.where(i > 0, i - 1, nx - 1) * ny + j, tl.where(i < nx - 1, i + 1, 0) * ny + j
    below, above = i * ny + tl.where(j > 0, j - 1, ny - 1), i * ny + tl.where(j < ny - 1, j + 1, 0)
    to_left = _beside(taken, node, left, i + WX > 0, 1.0, active)
    to_right = _beside(taken, node, right, i < nx - 1 + WX, 1.0, active)
    to_below = _beside(taken, node, below, j + WY > 0, factor, active)
    to_above = _beside(taken, node, above, j < ny - 1 + WY, factor, active)
    return left, right, below, above, to_left, to_right, to_below, to_above


@triton.jit(do_not_specialize=SIZES)
def relax(counts, taken, per_scene, before, after, particle, factor, nx, ny,
          WX: tl.constexpr, WY: tl.constexpr, CLOSED: tl.constexpr, FIRST: tl.constexpr,
          BLOCK: tl.constexpr):  # fmt: skip
    """Fill in `after` (B size,), the pressures after a sweep, from those before it; FIRST: from none."""
    scene = tl.program_id(1).to(tl.int64)
    node = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = node < nx * ny
    room = taken + scene * per_scene
    left, right, below, above, to_left, to_right, to_below, to_above = _faces(
        room, node, active, factor, nx, ny, WX, WY
    )
    diagonal = to_left + to_right + to_below + to_above
    inverse = tl.where(diagonal > CLOSED, 1 / tl.maximum(diagonal, CLOSED), 0.0)
    counted = tl.load(counts + scene * (nx * ny) + node, mask=active, other=0.0)
    change = counted * particle - (1 - tl.load(room + node, mask=active, other=1.0))
    pressure = tl.zeros((BLOCK,), tl.float32)
    if not FIRST:
        own = before + scene * (nx * ny)
        pressure = tl.load(own + node, mask=active, other=0.0)
        change -= to_left * (pressure - tl.load(own + left, mask=active, other=0.0))
        change -= to_right * (pressure - tl.load(own + right, mask=active, other=0.0))
        change -= to_below * (pressure - tl.load(own + below, mask=active, other=0.0))
        change -= to_above * (pressure - tl.load(own + above, mask=active, other=0.0))
    tl.store(after + scene * (nx * ny) + node, tl.maximum(pressure + inverse * change, 0.0), mask=active)


@triton.jit(do_not_specialize=SIZES)
def find_flow(taken, per_scene, pressures, flow, factor, nx, ny, WX: tl.constexpr,
              WY: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Fill in the displacements (B size, 2) at the nodes that pressures (B size,) drive."""
    scene = tl.program_id(1).to(tl.int64)
    node = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = node < nx * ny
    room, own = taken + scene * per_scene, pressures + scene * (nx * ny)
    left, right, below, above, to_left, to_right, to_below, to_above = _faces(
        room, node, active, factor, nx, ny, WX, WY
    )
    pressure = tl.load(own + node, mask=active, other=0.0)
    x = to_right * (pressure - tl.load(own + right, mask=active, other=0.0))
    x += to_left * (tl.load(own + left, mask=active, other=0.0) - pressure)
    y = to_above * (pressure - tl.load(own + above, mask=active, other=0.0))
    y += to_below * (tl.load(own + below, mask=active, other=0.0) - pressure)
    target = flow + 2 * (scene * (nx * ny) + node)
    tl.store(target, x / 2, mask=active)
    tl.store(target + 1, y / 2, mask=active)


@triton.jit
def _energy(x, y, u, v, pull_x, pull_y, mass, ratio):
    """Energy of particles with steps (u, v), times their mass."""
    each = (u * u + v * v * ratio * ratio) / 2 - x * pull_x - y * pull_y * ratio * ratio
    return tl.sum(tl.where(mass > 0, mass * each, 0.0), 0)


@triton.jit(do_not_specialize=SIZES)
def spread(path, weight, gravity, share, flow, spreads, energies, frames, count, tiles, left, right, down, up, ratio,
           nx, ny, WX: tl.constexpr, WY: tl.constexpr, CONTACT: tl.constexpr, SURFACE: tl.constexpr,
           SHIFT: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Spread a path's overfull cells, evenly over its frames.

    Args:
        path: (B, m + 1, N, 2), with `weight` and `gravity`.
        share: (B size,) of each cell's room that is obstacle, which nobody is spread into; if CONTACT.
        flow: (B size, 2), from `find_flow`.
        spreads: (B, m + 1, N, 2), is filled but for its first frame.
        energies: (B, m + 1, tiles, 2), is filled: sums over each block of the path's and of the spread path's energies
            in each frame, and at last of the end with the path's velocity there.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, begin, solid = p < count, scene * (frames + 1) * count + p, share + scene * (nx * ny)
    mass = tl.load(weight + scene * count + p, mask=active, other=0.0)
    pull_x, pull_y = tl.load(gravity + 2 * scene), tl.load(gravity + 2 * scene + 1)
    end_x, end_y = load(path, begin + frames * count, active)
    own = flow + 2 * scene * (nx * ny)
    shift_x = interpolate(own, end_x, end_y, 2 * ny, 2, active, nx, ny, WX, WY)
    shift_y = interpolate(own + 1, end_x, end_y, 2 * ny, 2, active, nx, ny, WX, WY)
    shift_x = tl.where(mass > 0, tl.minimum(tl.maximum(shift_x, -SHIFT), SHIFT), 0.0)
    shift_y = tl.where(mass > 0, tl.minimum(tl.maximum(shift_y, -SHIFT), SHIFT), 0.0)
    blocked = p < 0
    if CONTACT:
        for frame in range(1, frames + 1):
            x, y = load(path, begin + frame * count, active)
            x, y = confine(x + frame / frames * shift_x, left, right), confine(y + frame / frames * shift_y, down, up)
            blocked = blocked | (interpolate(solid, x, y, ny, 1, active, nx, ny, WX, WY) > SURFACE)
    x, y = load(path, begin, active)
    spread_x, spread_y, u, v = x, y, x * 0, y * 0
    here = energies + (scene * (frames + 1) * tiles + tl.program_id(0)) * 2
    for frame in range(1, frames + 1):
        next_x, next_y = load(path, begin + frame * count, active)
        moved_x = tl.where(blocked, next_x, confine(next_x + frame / frames * shift_x, left, right))
        moved_y = tl.where(blocked, next_y, confine(next_y + frame / frames * shift_y, down, up))
        store(spreads, begin + frame * count, moved_x, moved_y, active)
        u, v, spread_u, spread_v = next_x - x, next_y - y, moved_x - spread_x, moved_y - spread_y
        tl.store(here, _energy(next_x, next_y, u, v, pull_x, pull_y, mass, ratio))
        tl.store(here + 1, _energy(moved_x, moved_y, spread_u, spread_v, pull_x, pull_y, mass, ratio))
        here += 2 * tiles
        x, y, spread_x, spread_y = next_x, next_y, moved_x, moved_y
    tl.store(here, _energy(x, y, u, v, pull_x, pull_y, mass, ratio))
    tl.store(here + 1, _energy(spread_x, spread_y, u, v, pull_x, pull_y, mass, ratio))


@triton.jit(do_not_specialize=SIZES)
def land(path, spreads, energies, budget, frames, count, tiles, BLOCK: tl.constexpr, TILES: tl.constexpr):
    """Take spread paths back to the path, as far as each scene's energy (B,) demands."""
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, begin = p < count, scene * (frames + 1) * count + p
    tile, limit = tl.arange(0, TILES), tl.load(budget + scene)
    share = tl.full((), 1.0, tl.float32)
    for frame in range(frames + 1):
        own = energies + ((scene * (frames + 1) + frame) * tiles + tile) * 2
        before = tl.sum(tl.load(own, mask=tile < tiles, other=0.0), 0)
        after = tl.sum(tl.load(own + 1, mask=tile < tiles, other=0.0), 0)
        room, rise = tl.maximum(limit - before, 0.0), after - before
        possible = tl.where(rise > 0, room / tl.where(rise > 0, rise, 1.0), 0.0)
        share = tl.where(after > limit, tl.minimum(share, possible), share)
    for frame in range(1, frames + 1):
        x, y = load(path, begin + frame * count, active)
        moved_x, moved_y = load(spreads, begin + frame * count, active)
        x = tl.where(share < 1, x + share * (moved_x - x), moved_x)
        y = tl.where(share < 1, y + share * (moved_y - y), moved_y)
        store(spreads, begin + frame * count, x, y, active)
