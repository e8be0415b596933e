"""Kernels that lead paths off obstacles, in Triton; arrays as in `motion`.

They compute what the torch engine's `contact` computes.
"""

import triton
import triton.language as tl

from nmpm_triton.grid import SIZES, interpolate
from nmpm_triton.motion import confine, load, store


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
def _scene_pieces(squares, scene, entries, STEPS: tl.constexpr):
    """Pieces of a frame in which all particles of a scene are looked at, from squares (B, entries) of steps."""
    step = tl.arange(0, STEPS)
    longest = tl.load(squares + scene * entries + step, mask=step < entries, other=0.0)
    return _pieces(tl.sqrt(tl.max(longest, 0)))


@triton.jit(do_not_specialize=SIZES)
def touch(path, volume, share, squares, free, way, lengths, frames, count, tiles, entries, nx, ny,
          WX: tl.constexpr, WY: tl.constexpr, SURFACE: tl.constexpr, BLOCK: tl.constexpr,
          STEPS: tl.constexpr):  # fmt: skip
    """Find where particles first get too deep into an obstacle.

    Args:
        path: (B, m + 1, N, 2), with `volume` (B, N).
        share: (B size,) of each cell's room that is obstacle.
        squares: (B, entries), from `motion.flight` or `motion.advance`.
        free: (B, N) int32, is filled: pieces before that; -1 where it is nowhere, -2 for those that start too deep.
        way: (B, 2, N, 2), is filled: the last place before, and the rest of the way without its part into the solid.
        lengths: (B, tiles), is filled: the longest of those rests.
    """
    scene = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active, particle = p < count, scene * count + p
    real = tl.load(volume + particle, mask=active, other=0).to(tl.float32) > 0
    begin, solid = scene * (frames + 1) * count + p, share + scene * (nx * ny)
    pieces = _scene_pieces(squares, scene, entries, STEPS)
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
def hold(path, share, squares, free, way, lengths, frames, count, tiles, entries, left, right, down, up, nx, ny,
         WX: tl.constexpr, WY: tl.constexpr, SURFACE: tl.constexpr, BLOCK: tl.constexpr, STEPS: tl.constexpr,
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
    pieces = _scene_pieces(squares, scene, entries, STEPS)
    remaining = tl.maximum(frames * pieces - first, 1)
    for frame in range(1, frames + 1):
        x, y = load(path, begin + frame * count, active)
        passed, time = frame * pieces - first, frame / frames
        gone = tl.minimum(passed / remaining, part)
        slides, stuck = (first >= 0) & (passed > 0), first == -2
        x = tl.where(slides, last_x + along_x * gone, tl.where(stuck & (x == x), start_x + out_x * time, x))
        y = tl.where(slides, last_y + along_y * gone, tl.where(stuck & (y == y), start_y + out_y * time, y))
        store(path, begin + frame * count, confine(x, left, right), confine(y, down, up), active)
