"""Kernels that spread overfull cells, in Triton; arrays as in `motion`. They compute what the torch engine's `crowding`
computes. `volume` (B, N) are the particles' as multiples of the scene's, 0 for padding.
"""

import triton
import triton.language as tl

from nmpm_triton.grid import SIZES, find_nodes, interpolate
from nmpm_triton.motion import confine, load, load_masses, store


@triton.jit
def _add_ends(nodes, x, y, volume, nx, ny, WX: tl.constexpr, WY: tl.constexpr):
    """Add the volumes of particles to a scene's nodes."""
    i0, i1, a = find_nodes(x, nx, WX)
    j0, j1, b = find_nodes(y, ny, WY)
    active = volume > 0
    tl.atomic_add(nodes + i0 * ny + j0, volume * (1 - a) * (1 - b), mask=active, sem="relaxed")
    tl.atomic_add(nodes + i0 * ny + j1, volume * (1 - a) * b, mask=active, sem="relaxed")
    tl.atomic_add(nodes + i1 * ny + j0, volume * a * (1 - b), mask=active, sem="relaxed")
    tl.atomic_add(nodes + i1 * ny + j1, volume * a * b, mask=active, sem="relaxed")


@triton.jit(do_not_specialize=SIZES)
def count_ends(path, volume, counts, count, frames, nx, ny, WX: tl.constexpr, WY: tl.constexpr, BLOCK: tl.constexpr):
    """Add the volumes (B, N) of particles at the end of a path (B, m + 1, N, 2) to `counts` (B size,)."""
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = p < count
    there = tl.load(volume + scene * count + p, mask=active, other=0).to(tl.float32)
    x, y = load(path, scene * (frames + 1) * count + frames * count + p, active)
    _add_ends(counts + scene * (nx * ny), x, y, there, nx, ny, WX, WY)


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


@triton.jit
def _sweep(pressures, pressure, excess, left, right, below, above, to_left, to_right, to_below, to_above, active,
           CLOSED: tl.constexpr):  # fmt: skip
    """Pressures after a sweep, from those before it; `cg`, as others of the program may have written them."""
    change = excess - to_left * (pressure - tl.load(pressures + left, mask=active, other=0.0, cache_modifier=".cg"))
    change -= to_right * (pressure - tl.load(pressures + right, mask=active, other=0.0, cache_modifier=".cg"))
    change -= to_below * (pressure - tl.load(pressures + below, mask=active, other=0.0, cache_modifier=".cg"))
    change -= to_above * (pressure - tl.load(pressures + above, mask=active, other=0.0, cache_modifier=".cg"))
    return tl.maximum(pressure + _inverse(to_left + to_right + to_below + to_above, CLOSED) * change, 0.0)


@triton.jit
def _inverse(diagonal, CLOSED: tl.constexpr):
    return tl.where(diagonal > CLOSED, 1 / tl.maximum(diagonal, CLOSED), 0.0)


@triton.jit
def _excess(counts, room, node, particle, active):
    """What of the material in each cell exceeds its free volume."""
    counted = tl.load(counts + node, mask=active, other=0.0, cache_modifier=".cg")
    return counted * particle - (1 - tl.load(room + node, mask=active, other=1.0))


@triton.jit(do_not_specialize=SIZES)
def relax(counts, taken, per_scene, before, after, particle, factor, nx, ny,
          WX: tl.constexpr, WY: tl.constexpr, CLOSED: tl.constexpr, FIRST: tl.constexpr,
          BLOCK: tl.constexpr):  # fmt: skip
    """Fill in `after` (B size,), the pressures after a sweep, from those before it; FIRST: from none."""
    scene = tl.program_id(1).to(tl.int64)
    node = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = node < nx * ny
    room, first = taken + scene * per_scene, scene * (nx * ny)
    left, right, below, above, to_left, to_right, to_below, to_above = _faces(
        room, node, active, factor, nx, ny, WX, WY
    )
    excess = _excess(counts + first, room, node, particle, active)
    if FIRST:
        pressure = tl.maximum(_inverse(to_left + to_right + to_below + to_above, CLOSED) * excess, 0.0)
    else:
        pressure = tl.load(before + first + node, mask=active, other=0.0)
        pressure = _sweep(before + first, pressure, excess, left, right, below, above, to_left, to_right,
                          to_below, to_above, active, CLOSED)  # fmt: skip
    tl.store(after + first + node, pressure, mask=active)


@triton.jit
def _store_flow(target, pressures, node, pressure, left, right, below, above, to_left, to_right, to_below, to_above,
                active):  # fmt: skip
    """Store the displacements (size, 2) that pressures drive."""
    x = to_right * (pressure - tl.load(pressures + right, mask=active, other=0.0, cache_modifier=".cg"))
    x += to_left * (tl.load(pressures + left, mask=active, other=0.0, cache_modifier=".cg") - pressure)
    y = to_above * (pressure - tl.load(pressures + above, mask=active, other=0.0, cache_modifier=".cg"))
    y += to_below * (tl.load(pressures + below, mask=active, other=0.0, cache_modifier=".cg") - pressure)
    tl.store(target + 2 * node, x / 2, mask=active)
    tl.store(target + 2 * node + 1, y / 2, mask=active)


@triton.jit(do_not_specialize=SIZES)
def find_flow(taken, per_scene, pressures, flow, factor, nx, ny, WX: tl.constexpr,
              WY: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Fill in the displacements (B size, 2) at the nodes that pressures (B size,) drive."""
    scene = tl.program_id(1).to(tl.int64)
    node = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = node < nx * ny
    room, driving = taken + scene * per_scene, pressures + scene * (nx * ny)
    left, right, below, above, to_left, to_right, to_below, to_above = _faces(
        room, node, active, factor, nx, ny, WX, WY
    )
    pressure = tl.load(driving + node, mask=active, other=0.0)
    _store_flow(flow + 2 * scene * (nx * ny), driving, node, pressure, left, right, below, above, to_left, to_right,
                to_below, to_above, active)  # fmt: skip


@triton.jit(do_not_specialize=SIZES)
def press(path, volume, taken, per_scene, counts, pressures, flow, particle, factor, count, frames, nx, ny,
          WX: tl.constexpr, WY: tl.constexpr, CLOSED: tl.constexpr, SWEEPS: tl.constexpr, PARTICLES: tl.constexpr,
          BLOCK: tl.constexpr):  # fmt: skip
    """`count_ends`, all sweeps of `relax` and `find_flow`, where a scene's grid is one program's.

    `counts` (B size,) and `pressures` (B, 2, size) are scratch.
    """
    scene = tl.program_id(0).to(tl.int64)
    node = tl.arange(0, BLOCK)
    active, first = node < nx * ny, scene * (nx * ny)
    tl.store(counts + first + node, tl.zeros((BLOCK,), tl.float32), mask=active)
    tl.debug_barrier()
    for begin in range(0, count, PARTICLES):
        p = begin + tl.arange(0, PARTICLES)
        there = tl.load(volume + scene * count + p, mask=p < count, other=0).to(tl.float32)
        x, y = load(path, scene * (frames + 1) * count + frames * count + p, p < count)
        _add_ends(counts + first, x, y, there, nx, ny, WX, WY)
    tl.debug_barrier()
    room, driving = taken + scene * per_scene, pressures + 2 * first
    left, right, below, above, to_left, to_right, to_below, to_above = _faces(
        room, node, active, factor, nx, ny, WX, WY
    )
    excess = _excess(counts + first, room, node, particle, active)
    pressure = tl.maximum(_inverse(to_left + to_right + to_below + to_above, CLOSED) * excess, 0.0)
    tl.store(driving + node, pressure, mask=active)
    tl.debug_barrier()
    for sweep in range(1, SWEEPS):  # to and from one half of the scratch in turn, so that nobody reads what is new
        pressure = _sweep(driving + (sweep + 1) % 2 * (nx * ny), pressure, excess, left, right, below, above,
                          to_left, to_right, to_below, to_above, active, CLOSED)  # fmt: skip
        tl.store(driving + sweep % 2 * (nx * ny) + node, pressure, mask=active)
        tl.debug_barrier()
    _store_flow(flow + 2 * first, driving + (SWEEPS - 1) % 2 * (nx * ny), node, pressure, left, right, below, above,
                to_left, to_right, to_below, to_above, active)  # fmt: skip


@triton.jit
def _energy(x, y, u, v, pull_x, pull_y, mass, ratio):
    """Energy of particles with steps (u, v), times their mass."""
    each = (u * u + v * v * ratio * ratio) / 2 - x * pull_x - y * pull_y * ratio * ratio
    return tl.sum(tl.where(mass > 0, mass * each, 0.0), 0)


@triton.jit
def _shift(path, flow, share, begin, there, frames, count, left, right, down, up, active, nx, ny, WX: tl.constexpr,
           WY: tl.constexpr, CONTACT: tl.constexpr, SURFACE: tl.constexpr, SHIFT: tl.constexpr):  # fmt: skip
    """Displacements of particles at the path's end; 0 where `there` is 0, and for those that would enter obstacles."""
    end_x, end_y = load(path, begin + frames * count, active)
    shift_x = interpolate(flow, end_x, end_y, 2 * ny, 2, active, nx, ny, WX, WY)
    shift_y = interpolate(flow + 1, end_x, end_y, 2 * ny, 2, active, nx, ny, WX, WY)
    shift_x = tl.where(there > 0, tl.minimum(tl.maximum(shift_x, -SHIFT), SHIFT), 0.0)
    shift_y = tl.where(there > 0, tl.minimum(tl.maximum(shift_y, -SHIFT), SHIFT), 0.0)
    if CONTACT:
        blocked = there < 0
        for frame in range(1, frames + 1):
            x, y = load(path, begin + frame * count, active)
            x, y = confine(x + frame / frames * shift_x, left, right), confine(y + frame / frames * shift_y, down, up)
            blocked = blocked | (interpolate(share, x, y, ny, 1, active, nx, ny, WX, WY) > SURFACE)
        shift_x, shift_y = tl.where(blocked, 0.0, shift_x), tl.where(blocked, 0.0, shift_y)
    return shift_x, shift_y


@triton.jit
def _affordable(part, before, after, limit):
    """The part of the way between two paths that a scene can afford, also in a frame of these energies."""
    rise = after - before
    possible = tl.where(rise > 0, tl.maximum(limit - before, 0.0) / tl.where(rise > 0, rise, 1.0), 0.0)
    return tl.where(after > limit, tl.minimum(part, possible), part)


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
    active, begin = p < count, scene * (frames + 1) * count + p
    mass = tl.load(weight + scene * count + p, mask=active, other=0.0)
    pull_x, pull_y = tl.load(gravity + 2 * scene), tl.load(gravity + 2 * scene + 1)
    shift_x, shift_y = _shift(path, flow + 2 * scene * (nx * ny), share + scene * (nx * ny), begin, mass, frames, count,
                              left, right, down, up, active, nx, ny, WX, WY, CONTACT, SURFACE, SHIFT)  # fmt: skip
    x, y = load(path, begin, active)
    spread_x, spread_y, u, v = x, y, x * 0, y * 0
    here = energies + (scene * (frames + 1) * tiles + tl.program_id(0)) * 2
    for frame in range(1, frames + 1):
        next_x, next_y = load(path, begin + frame * count, active)
        moved_x, moved_y = _moved(next_x, next_y, shift_x, shift_y, frame / frames, left, right, down, up)
        store(spreads, begin + frame * count, moved_x, moved_y, active)
        u, v, spread_u, spread_v = next_x - x, next_y - y, moved_x - spread_x, moved_y - spread_y
        tl.store(here, _energy(next_x, next_y, u, v, pull_x, pull_y, mass, ratio))
        tl.store(here + 1, _energy(moved_x, moved_y, spread_u, spread_v, pull_x, pull_y, mass, ratio))
        here += 2 * tiles
        x, y, spread_x, spread_y = next_x, next_y, moved_x, moved_y
    tl.store(here, _energy(x, y, u, v, pull_x, pull_y, mass, ratio))
    tl.store(here + 1, _energy(spread_x, spread_y, u, v, pull_x, pull_y, mass, ratio))


@triton.jit
def _moved(x, y, shift_x, shift_y, part, left, right, down, up):
    """Places moved by a part of the shifts, within the bounds; where nothing is shifted they stay, to the bit."""
    x = tl.where(shift_x == 0, x, confine(x + part * shift_x, left, right))
    return x, tl.where(shift_y == 0, y, confine(y + part * shift_y, down, up))


@triton.jit(do_not_specialize=SIZES)
def take_back(path, spreads, energies, budget, frames, count, tiles, BLOCK: tl.constexpr, TILES: tl.constexpr):
    """Take spread paths back to the path, as far as each scene's energy (B,) demands."""
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, begin = p < count, scene * (frames + 1) * count + p
    tile, limit = tl.arange(0, TILES), tl.load(budget + scene)
    part = tl.full((), 1.0, tl.float32)
    for frame in range(frames + 1):
        sums = energies + ((scene * (frames + 1) + frame) * tiles + tile) * 2
        before = tl.sum(tl.load(sums, mask=tile < tiles, other=0.0), 0)
        part = _affordable(part, before, tl.sum(tl.load(sums + 1, mask=tile < tiles, other=0.0), 0), limit)
    for frame in range(1, frames + 1):
        x, y = load(path, begin + frame * count, active)
        moved_x, moved_y = load(spreads, begin + frame * count, active)
        x = tl.where(part < 1, x + part * (moved_x - x), moved_x)
        y = tl.where(part < 1, y + part * (moved_y - y), moved_y)
        store(spreads, begin + frame * count, x, y, active)


@triton.jit(do_not_specialize=SIZES)
def spread_scene(path, volume, material, gravity, share, flow, budget, spreads, frames, count, left, right, down, up,
                 ratio, nx, ny, WX: tl.constexpr, WY: tl.constexpr, CONTACT: tl.constexpr, SURFACE: tl.constexpr,
                 SHIFT: tl.constexpr, LIMITED: tl.constexpr, MASSES: tl.constexpr,
                 BLOCK: tl.constexpr):  # fmt: skip
    """`spread` and, if LIMITED, `take_back`, where a scene is one program's; arguments as there and of `flight`."""
    scene = tl.program_id(1).to(tl.int64)
    p = tl.arange(0, BLOCK)
    active, begin = p < count, scene * (frames + 1) * count + p
    mass = load_masses(volume, material, scene * count + p, active, BLOCK, MASSES)
    pull_x, pull_y = tl.load(gravity + 2 * scene), tl.load(gravity + 2 * scene + 1)
    shift_x, shift_y = _shift(path, flow + 2 * scene * (nx * ny), share + scene * (nx * ny), begin, mass, frames, count,
                              left, right, down, up, active, nx, ny, WX, WY, CONTACT, SURFACE, SHIFT)  # fmt: skip
    part = tl.full((), 1.0, tl.float32)
    if LIMITED:
        limit = tl.load(budget + scene)
        x, y = load(path, begin, active)
        spread_x, spread_y, u, v = x, y, x * 0, y * 0
        for frame in range(1, frames + 1):
            next_x, next_y = load(path, begin + frame * count, active)
            moved_x, moved_y = _moved(next_x, next_y, shift_x, shift_y, frame / frames, left, right, down, up)
            u, v, spread_u, spread_v = next_x - x, next_y - y, moved_x - spread_x, moved_y - spread_y
            before = _energy(next_x, next_y, u, v, pull_x, pull_y, mass, ratio)
            after = _energy(moved_x, moved_y, spread_u, spread_v, pull_x, pull_y, mass, ratio)
            part = _affordable(part, before, after, limit)
            x, y, spread_x, spread_y = next_x, next_y, moved_x, moved_y
        before = _energy(x, y, u, v, pull_x, pull_y, mass, ratio)
        part = _affordable(part, before, _energy(spread_x, spread_y, u, v, pull_x, pull_y, mass, ratio), limit)
    for frame in range(1, frames + 1):
        x, y = load(path, begin + frame * count, active)
        moved_x, moved_y = _moved(x, y, shift_x, shift_y, frame / frames, left, right, down, up)
        moved_x = tl.where(part < 1, x + part * (moved_x - x), moved_x)
        moved_y = tl.where(part < 1, y + part * (moved_y - y), moved_y)
        store(spreads, begin + frame * count, moved_x, moved_y, active)
