"""The network on windows of the grid instead of all of it, where a call's particles leave much of the grid unread.

A processor that declares its `radius` computes a cell from those within it. A window around the cells that particles
read, wider by the radius on each side that is not the domain's, therefore holds what the whole grid would, to rounding.

    occupied.py   blocks of cells that the particles of a bundle may read, from the grid state
    axis.py       where a window along one axis begins and ends, so that the network can take it
    cover.py      the windows that hold these blocks at the least cost
    network.py    gather windows → network on batches of equal windows → scatter
    memory.py     the last output in a rollout, which stays where the network sees no change, as in material at rest
    reads.py      check that a path has read nothing else; the caller then computes the whole grid
    choice.py     `Windows`, the options, and the decision between windows and the whole grid
"""

from nmpm.emulator.windows.choice import Coverage, Windows, choose_windows, find_in_windows, usable_memory
from nmpm.emulator.windows.memory import Memory
from nmpm.emulator.windows.reads import UncoveredReadError

__all__ = [
    "Coverage",
    "Memory",
    "UncoveredReadError",
    "Windows",
    "choose_windows",
    "find_in_windows",
    "usable_memory",
]
