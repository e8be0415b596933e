"""Facts about a dataset that are found in its trajectories: bounds, boundaries, time step, gravity, types, volume.

    finder = FactFinder(dim=2)
    for trajectory in trajectories:
        finder.add(trajectory)
    metadata = finder.facts().complete(metadata, unknown)

Positions are read once, one trajectory at a time; a few small samples are kept. Particles that are absent (NaN) count
nowhere.
"""

from __future__ import annotations

from nmpm.data.facts.fact import FOUND as FOUND
from nmpm.data.facts.fact import Fact as Fact
from nmpm.data.facts.fact import Facts as Facts
from nmpm.data.facts.finder import FactFinder as FactFinder
from nmpm.data.facts.finder import find_facts as find_facts
