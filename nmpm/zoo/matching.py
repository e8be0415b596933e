"""Matches of pretrained models with data of any kind."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.data.dataset import Dataset, load_trajectories
from nmpm.data.sources import FolderSource
from nmpm.data.survey import measure_motion
from nmpm.emulator import Emulator
from nmpm.emulator.similarity import Match, find_match
from nmpm.errors import ConfigError
from nmpm.scene import Motion, Scene

if TYPE_CHECKING:
    from nmpm.data.datamodule import TrajectoryDataModule


def match_data(
    emulator: Emulator,
    name: str,
    data: Scene | str | Path | Dataset | TrajectoryDataModule,
    materials: Mapping[str, str] | None = None,
    stride: Fraction | float | str | None = None,
    strict: bool = False,
) -> Match:
    """The match of the emulator of a model with data; arguments and errors as those of `Pretrained.fit_to`."""
    step, names = None if stride is None else read_stride(stride), (name, "the data")
    if isinstance(data, Scene):
        return find_match(emulator, data, Motion(), materials, step, strict, names)
    if isinstance(data, str | Path):
        data = load_trajectories(data)
    source = data.source if isinstance(data, Dataset) else data.data_source
    names = name, source.description
    is_recorded = isinstance(source, FolderSource)  # simulated data state what is needed
    motion = measure_motion(source.folder, source.metadata) if is_recorded else Motion()
    return find_match(emulator, source.scene, motion, materials, step, strict, names)


def read_stride(stride: Fraction | float | str) -> Fraction:
    """A stride such as 2, 0.25 or "1/4".

    Raises:
        ConfigError: if it is no number.
    """
    try:
        return Fraction(stride).limit_denominator(1000)
    except (ValueError, ZeroDivisionError, OverflowError, TypeError) as error:
        raise ConfigError(f"stride = {stride!r}: give a whole number, k, or its inverse, 1/k.") from error
