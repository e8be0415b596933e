"""Kernels that lead paths off obstacles and out of overfull cells, in Triton; arrays as in `motion`.

They compute what the torch engine's `contact` and `crowding` compute.
"""

import triton
import triton.language as tl

from nmpm.emulator.engines.triton.grid import SIZES, find_nodes, interpolate
from nmpm.emulator.engines.triton.motion import SUMS, confine, load, store


@triton.jit
def _inward(share, x, y, active, nx, ny, WX: tl.constexpr, WY: tl.constexpr):
    """The unit vector along which the obstacle gets deeper; zero where it is even."""
    u = interpolate(share, x + 0.5, y, ny, 1, active, nx, ny, WX, WY)
    u -= interpolate(share, x - 0.5, y, ny, 1, active, nx, ny, WX, WY)
    v = interpolate(share, x, y + 0.5, ny, 1, active, nx, ny, WX, WY)
    v -= interpolate(share, x, y - 0.5, ny, 1, active, nx, ny, WX, WY)
    length = tl.maximum(tl.sqrt(u * u + v * v), 1e-12)
    even = (tl.abs(u) < 1e-5) & (tl.abs(v) < 1e-5)
    return tl.where(even, 0.0, u / length), tl.where(even, 0.0, v / length)


@triton.jit
def _pieces(longest):
    """Pieces of at most half a cell in a length, 64 at most."""
    return tl.minimum(tl.maximum(tl.ceil(2 * longest), 1.0), 64.0).to(tl.int32)


@triton.jit
def _scene_pieces(sums, scene, frames, tiles, STEPS: tl.constexpr):
    """Pieces of a frame in which all particles of a scene are looked at."""
    step = tl.arange(0, STEPS)
    squares = tl.load(sums + (scene * frames * tiles + step) * SUMS + 5, mask=step < frames * tiles, other=0.0)
    return _pieces(tl.sqrt(tl.max(squares, 0)))


@triton.jit(do_not_specialize=SIZES)
def touch(path, weight, share, sums, free, way, lengths, frames, count, tiles, nx, ny,
          WX: tl.constexpr, WY: tl.constexpr, SURFACE: tl.constexpr, BLOCK: tl.constexpr,
          STEPS: tl.constexpr):  # fmt: skip
    """Find where particles first get too deep into an obstacle.

    Args:
        path: (B, m + 1, N, 2), with `weight` (B, N).
        share: (B size,) of each cell's room that is obstacle.
        sums: From `motion.advance`.
        free: (B, N) int32, is filled: pieces before that; -1 where it is nowhere, -2 for those that start too deep.
        way: (B, 2, N, 2), is filled: the last place before, and the rest of the way without its part into the solid.
        lengths: (B, tiles), is filled: the longest of those rests.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, particle = p < count, scene * count + p
    real = tl.load(weight + particle, mask=active, other=0.0) > 0
    begin, solid = scene * (frames + 1) * count + p, share + scene * (nx * ny)
    pieces = _scene_pieces(sums, scene, frames, tiles, STEPS)
    start_x, start_y = load(path, begin, active)
    stuck = real & (interpolate(solid, start_x, start_y, ny, 1, active, nx, ny, WX, WY) > SURFACE)
    first = tl.full((BLOCK,), -1, tl.int32)
    x, y, hit_x, hit_y, last_x, last_y = start_x, start_y, start_x, start_y, start_x, start_y
    from_x, from_y = start_x, start_y
    for frame in range(frames):
        to_x, to_y = load(path, begin + (frame + 1) * count, active)
        for piece in range(pieces):
            part = (piece + 1) / pieces
            at_x, at_y = from_x + (to_x - from_x) * part, from_y + (to_y - from_y) * part
            depth = interpolate(solid, at_x, at_y, ny, 1, active, nx, ny, WX, WY)
            hits = (first < 0) & ((depth <= SURFACE) == 0)
            last_x, last_y = tl.where(hits, x, last_x), tl.where(hits, y, last_y)
            hit_x, hit_y = tl.where(hits, at_x, hit_x), tl.where(hits, at_y, hit_y)
            first = tl.where(hits, frame * pieces + piece, first)
            x, y = at_x, at_y
        from_x, from_y = to_x, to_y
    hits = real & (first >= 0)
    inward_x, inward_y = _inward(solid, hit_x, hit_y, active, nx, ny, WX, WY)
    end_x, end_y = load(path, begin + frames * count, active)
    rest_x, rest_y = end_x - last_x, end_y - last_y
    into = tl.maximum(rest_x * inward_x + rest_y * inward_y, 0.0)
    along_x, along_y = tl.where(hits, rest_x - into * inward_x, 0.0), tl.where(hits, rest_y - into * inward_y, 0.0)
    tl.store(free + particle, tl.where(stuck, -2, tl.where(hits, first, -1)), mask=active)
    row = scene * 2 * count + p
    store(way, row, last_x, last_y, active)
    store(way, row + count, along_x, along_y, active)
    length = tl.sqrt(along_x * along_x + along_y * along_y)
    longest = tl.max(tl.where(length < float("inf"), length, 0.0), 0)
    tl.store(lengths + scene * tiles + tl.program_id(0), longest)


@triton.jit
def _slide(solid, last_x, last_y, along_x, along_y, finer, active, nx, ny,
           WX: tl.constexpr, WY: tl.constexpr, SURFACE: tl.constexpr):  # fmt: skip
    """Share of the rest of the way up to where the surface bends into it, looked at in `finer` pieces."""
    passed = tl.zeros_like(last_x).to(tl.int32) + finer
    for piece in range(finer):
        part = (piece + 1) / finer
        depth = interpolate(solid, last_x + along_x * part, last_y + along_y * part, ny, 1, active, nx, ny, WX, WY)
        passed = tl.where(((depth <= SURFACE) == 0) & (passed == finer), piece, passed)
    return passed / finer


@triton.jit
def _way_out(solid, x, y, active, nx, ny, WX: tl.constexpr, WY: tl.constexpr,
             SURFACE: tl.constexpr):  # fmt: skip
    """The way straight out of an obstacle, or to where it is least deep."""
    inward_x, inward_y = _inward(solid, x, y, active, nx, ny, WX, WY)
    lowest = interpolate(solid, x, y, ny, 1, active, nx, ny, WX, WY)
    best = tl.zeros_like(x)
    for ahead in tl.static_range(1, 5):
        depth = interpolate(solid, x - inward_x * (0.5 * ahead), y - inward_y * (0.5 * ahead), ny, 1, active, nx, ny,
                            WX, WY)  # fmt: skip
        better = (lowest > SURFACE) & (depth < lowest)
        best, lowest = tl.where(better, 0.5 * ahead, best), tl.where(better, depth, lowest)
    return -inward_x * best, -inward_y * best


@triton.jit(do_not_specialize=SIZES)
def hold(path, share, sums, free, way, lengths, frames, count, tiles, left, right, down, up, nx, ny, WX: tl.constexpr,
         WY: tl.constexpr, SURFACE: tl.constexpr, BLOCK: tl.constexpr, STEPS: tl.constexpr,
         TILES: tl.constexpr):  # fmt: skip
    """Let particles slide along obstacles, or out of them, by the results of `touch`."""
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, begin, solid = p < count, scene * (frames + 1) * count + p, share + scene * (nx * ny)
    first = tl.load(free + scene * count + p, mask=active, other=-1)
    start_x, start_y = load(path, begin, active)
    last_x, last_y = load(way, scene * 2 * count + p, active)
    along_x, along_y = load(way, scene * 2 * count + count + p, active)
    tile = tl.arange(0, TILES)
    finer = _pieces(tl.max(tl.load(lengths + scene * tiles + tile, mask=tile < tiles, other=0.0), 0))
    part = _slide(solid, last_x, last_y, along_x, along_y, finer, active, nx, ny, WX, WY, SURFACE)
    out_x, out_y = _way_out(solid, start_x, start_y, active, nx, ny, WX, WY, SURFACE)
    pieces = _scene_pieces(sums, scene, frames, tiles, STEPS)
    remaining = tl.maximum(frames * pieces - first, 1)
    for frame in range(1, frames + 1):
        x, y = load(path, begin + frame * count, active)
        passed, time = frame * pieces - first, frame / frames
        gone = tl.minimum(passed / remaining, part)
        slides, stuck = (first >= 0) & (passed > 0), first == -2
        x = tl.where(slides, last_x + along_x * gone, tl.where(stuck & (x == x), start_x + out_x * time, x))
        y = tl.where(slides, last_y + along_y * gone, tl.where(stuck & (y == y), start_y + out_y * time, y))
        store(path, begin + frame * count, confine(x, left, right), confine(y, down, up), active)


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
    nodes = counts + scene * (nx * ny)
    tl.atomic_add(nodes + i0 * ny + j0, (1 - a) * (1 - b), mask=active, sem="relaxed")
    tl.atomic_add(nodes + i0 * ny + j1, (1 - a) * b, mask=active, sem="relaxed")
    tl.atomic_add(nodes + i1 * ny + j0, a * (1 - b), mask=active, sem="relaxed")
    tl.atomic_add(nodes + i1 * ny + j1, a * b, mask=active, sem="relaxed")


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
        pressures = before + scene * (nx * ny)
        pressure = tl.load(pressures + node, mask=active, other=0.0)
        change -= to_left * (pressure - tl.load(pressures + left, mask=active, other=0.0))
        change -= to_right * (pressure - tl.load(pressures + right, mask=active, other=0.0))
        change -= to_below * (pressure - tl.load(pressures + below, mask=active, other=0.0))
        change -= to_above * (pressure - tl.load(pressures + above, mask=active, other=0.0))
    tl.store(after + scene * (nx * ny) + node, tl.maximum(pressure + inverse * change, 0.0), mask=active)


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
    x = to_right * (pressure - tl.load(driving + right, mask=active, other=0.0))
    x += to_left * (tl.load(driving + left, mask=active, other=0.0) - pressure)
    y = to_above * (pressure - tl.load(driving + above, mask=active, other=0.0))
    y += to_below * (tl.load(driving + below, mask=active, other=0.0) - pressure)
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
    flows = flow + 2 * scene * (nx * ny)
    shift_x = interpolate(flows, end_x, end_y, 2 * ny, 2, active, nx, ny, WX, WY)
    shift_y = interpolate(flows + 1, end_x, end_y, 2 * ny, 2, active, nx, ny, WX, WY)
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
        sums = energies + ((scene * (frames + 1) + frame) * tiles + tile) * 2
        before = tl.sum(tl.load(sums, mask=tile < tiles, other=0.0), 0)
        after = tl.sum(tl.load(sums + 1, mask=tile < tiles, other=0.0), 0)
        room, rise = tl.maximum(limit - before, 0.0), after - before
        possible = tl.where(rise > 0, room / tl.where(rise > 0, rise, 1.0), 0.0)
        share = tl.where(after > limit, tl.minimum(share, possible), share)
    for frame in range(1, frames + 1):
        x, y = load(path, begin + frame * count, active)
        moved_x, moved_y = load(spreads, begin + frame * count, active)
        x = tl.where(share < 1, x + share * (moved_x - x), moved_x)
        y = tl.where(share < 1, y + share * (moved_y - y), moved_y)
        store(spreads, begin + frame * count, x, y, active)
