"""The measures that `nmpm zoo refresh --measure` adds to cards, one per file.

A measure takes a model, its entry's folder and the folder of its data, or None to simulate its test scenes from their
seeds; it returns the keys of the card that it replaces, and may write pictures into the entry's folder. Times are
measured in `nmpm.zoo.speed`, as choosing a variant needs them without all else here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from nmpm.zoo.measures.quality import quality_facts
from nmpm.zoo.measures.simulator import floor_facts, twin_facts
from nmpm.zoo.measures.stress import invariant_facts, stress_facts
from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.speed import speed_facts

Measure = Callable[[Pretrained, Path, Path | None], dict[str, Any]]

MEASURES: Mapping[str, Measure] = MappingProxyType(
    {
        "speed": speed_facts,
        "quality": quality_facts,
        "twin": twin_facts,
        "floor": floor_facts,
        "stress": stress_facts,
        "invariants": invariant_facts,
    }
)
