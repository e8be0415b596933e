"""The rule for the number of grid cells, for new configurations and for `nmpm inspect`.

A grid is best where an occupied cell holds about 7 particles in two dimensions (2.6 per axis) after a training of a
quarter of an hour, and 4 (2 per axis) after two hours: finer grids know more, and take more steps to learn it. Coarser
ones are chosen where particles would cross cells too fast, the steps would be too few, or memory would not suffice.
Numbers are multiples of 8, to which a U-Net of depth 3 pads each axis in any case.

The constants come from the shipped configurations: goop would have 40 cells (shipped: 32), the heated channel the same
32, waterdrop and waterramps 32 (shipped: the paper's 64).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from nmpm.scene import Interval

MULTIPLE = 8
"""Cells of the finest level for one of the coarsest, in a U-Net of depth 3; periodic axes need multiples of it."""
PER_AXIS, MINUTES, GROWTH = 2.6, 15.0, 0.13
"""Particles per occupied cell and axis for a training of so many minutes; fewer by this power of the minutes."""
LEAST_CELLS = {1: 32, 2: 32, 3: 16}
"""Along the longest side, by dimension: walls, and gaps between bodies, are lost on coarser grids."""
LEAST_ACROSS, LEAST_PER_CELL = 16, 1.4
"""Along the shortest side, where occupied cells have so many particles then: water on a wide floor has a depth, too."""
MOST_CELLS = 512
MOST_SPEED = 2.5
"""Cells per frame that all but the fastest 0.1% of particles should stay below."""
LEAST_STEPS = 2000
"""Steps of a training; the first thousand halve errors most."""
TRAINING_SHARE = 0.8
"""Of a training's time that its steps take; validations take the rest."""
MEMORY_SHARE = 0.7
"""Of the free memory that a training may take."""
_OBLONG = 0.125  # of a cell's width, by which it may be longer along one axis
_FINEST, _COARSEST, _CANDIDATES = 1.25, 8.0, 12  # spacings of particles to a cell
_CELL_SECONDS = {1: 1.6e-9, 2: 4.7e-9, 3: 12.5e-9}  # of a core, by dimension; times width²
_PARTICLE_SECONDS, _STEP_SECONDS = 2e-6, 0.02  # the latter of the optimizer
_BYTES, _BASE_BYTES = {1: 75, 2: 75, 3: 115}, 0.4e9  # of a cell, times width


@dataclass(frozen=True)
class GridFacts:
    """Facts about the data on one grid."""

    cells: int  # cells along the longest side
    shape: tuple[int, ...]  # cells along each axis
    per_cell: float  # particles per occupied cell, median over frames
    median_speed: float  # median speed of the moving particles, in cells per frame
    high_speed: float  # 99.9% quantile of their speeds, in cells per frame
    most_speed: float  # largest speed, in cells per frame


@dataclass(frozen=True)
class TrainingSize:
    """What a training step computes, apart from the grid: windows, bundles, and channels of the U-Net."""

    batch_size: int
    unroll: int
    width: int

    @classmethod
    def of(cls, dim: int) -> TrainingSize:
        """That of the shipped configurations in so many dimensions."""
        return cls(4, 2, 24) if dim == 3 else cls(8, 4, 32)

    def seconds(self, shape: Sequence[int], particles: int) -> float:
        """Seconds of a step on one core of an AMD EPYC in float32, to 30%; other machines differ by a factor."""
        particle_seconds = _PARTICLE_SECONDS * particles * self.batch_size * self.unroll
        return _STEP_SECONDS + self.network_seconds(shape) + particle_seconds

    def network_seconds(self, shape: Sequence[int]) -> float:
        """Those of the network alone."""
        cells = self.batch_size * self.unroll * padded_cells(shape)
        return _CELL_SECONDS[len(shape)] * cells * self.width**2

    def memory(self, shape: Sequence[int]) -> float:
        """Bytes that a training takes on the CPU, to 20%."""
        numbers = self.batch_size * self.unroll * self.width * padded_cells(shape)
        return _BASE_BYTES + _BYTES[len(shape)] * numbers


@dataclass(frozen=True)
class Machine:
    """What a training has: seconds of a step over those of `TrainingSize.seconds`, bytes of memory, minutes.

    By default two cores of that processor.
    """

    slowness: float = 0.6
    memory: float = math.inf
    minutes: float = MINUTES

    def steps(self, seconds: float) -> int:
        """Training steps of so many seconds that fit into the time, beside validations."""
        return int(TRAINING_SHARE * 60 * self.minutes / seconds)


@dataclass(frozen=True)
class GridCost:
    """What a training on a grid costs."""

    seconds: float  # of a step
    steps: int  # in the time
    memory: float  # bytes
    fits: bool  # into the memory


def grid_cost(shape: Sequence[int], particles: int, machine: Machine, size: TrainingSize | None = None) -> GridCost:
    """The cost of a training on a grid with so many moving particles in a trajectory, of the size that suits both."""
    size = size or training_size(shape, particles, machine)
    seconds, memory = machine.slowness * size.seconds(shape, particles), size.memory(shape)
    return GridCost(seconds, machine.steps(seconds), memory, memory <= MEMORY_SHARE * machine.memory)


def training_size(shape: Sequence[int], particles: int, machine: Machine) -> TrainingSize:
    """That of the shipped configurations, in 3-D two thirds as wide where the steps would be too few otherwise."""
    usual = TrainingSize.of(len(shape))
    narrow = replace(usual, width=16) if len(shape) == 3 else usual
    return usual if grid_cost(shape, particles, machine, usual).steps >= LEAST_STEPS else narrow


def recommended_cells(grids: Sequence[GridFacts], particles: int, machine: Machine | None = None) -> int:
    """The cells along the longest side, of those of some grids, that the rule recommends.

    Args:
        grids: Facts about the data on grids with the numbers of cells of `candidates`.
        particles: Moving particles in a trajectory, at most.
        machine: What the training has; a quarter of an hour on two cores when left out.
    """
    machine, dim = machine or Machine(), len(grids[0].shape)
    target = (PER_AXIS * (machine.minutes / MINUTES) ** -GROWTH) ** dim

    def suits(grid: GridFacts) -> bool:
        cost = grid_cost(grid.shape, particles, machine)
        enough = grid.cells >= LEAST_CELLS[dim] and grid.high_speed <= MOST_SPEED
        return enough and cost.fits and cost.steps >= LEAST_STEPS

    suitable = [grid for grid in grids if suits(grid)]
    wide = [grid for grid in suitable if min(grid.shape) >= LEAST_ACROSS and grid.per_cell >= LEAST_PER_CELL]
    enough = [grid for grid in grids if grid.cells >= LEAST_CELLS[dim]] or list(grids)
    fitting = wide or suitable or [min(enough, key=lambda grid: grid.cells)]
    return min(fitting, key=lambda grid: abs(math.log(max(grid.per_cell, 1.0) / target))).cells


def candidates(domain: Sequence[Interval], spacing: float) -> tuple[int, ...]:
    """Cells along the longest side worth a look, ascending: from 8 to 1.25 spacings of particles to a cell."""
    sides, dim = [high - low for low, high in domain], len(domain)
    longest, least = max(sides), MULTIPLE * max(sides) / min(sides)  # else cells of the shortest axis are narrower
    low = min(max(longest / (_COARSEST * spacing), LEAST_CELLS[dim] / 2, least), MOST_CELLS / 2)
    high = min(max(longest / (_FINEST * spacing), 2 * low, 2 * LEAST_CELLS[dim]), MOST_CELLS)
    steps = [low * (high / low) ** (index / (_CANDIDATES - 1)) for index in range(_CANDIDATES)]
    return tuple(dict.fromkeys(math.ceil(cells / MULTIPLE - 0.5) * MULTIPLE for cells in steps))


def grid_shape(domain: Sequence[Interval], periodic: Sequence[bool], cells: int) -> tuple[int, ...]:
    """Cells along each axis for so many along the longest side: square, or nearly so where that saves padding."""
    longest = max(high - low for low, high in domain)
    numbers = [cells * (high - low) / longest for low, high in domain]
    return tuple(_whole_cells(number, wraps) for number, wraps in zip(numbers, periodic, strict=True))


def _whole_cells(number: float, wraps: bool) -> int:
    multiple = round(number / MULTIPLE) if wraps else math.floor(number / MULTIPLE)
    fewer = max(multiple, 1) * MULTIPLE
    return fewer if wraps or number <= fewer * (1 + _OBLONG) else round(number)


def padded_cells(shape: Sequence[int]) -> int:
    """Cells that a U-Net computes: each axis is a multiple of 8."""
    return math.prod(-(-n // MULTIPLE) * MULTIPLE for n in shape)
