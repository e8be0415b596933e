"""Presets by their shipped names, or from YAML files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from nmpm._support.bounded_files import parse_yaml, read_text
from nmpm._support.messages import one_line
from nmpm._support.shipped import find_preset, preset_names
from nmpm.errors import ConfigError
from nmpm.sim.mpm.mixture import MpmMixture
from nmpm.sim.mpm.preset import MpmPreset
from nmpm.sim.preset import Preset
from nmpm.sim.sph.preset import SphPreset

SOLVERS: dict[str, type[Preset]] = {kind.solver: kind for kind in (MpmPreset, MpmMixture, SphPreset)}


def load_preset(name_or_path: str | Path) -> Preset:
    """A preset by its shipped name, or from a YAML file.

    Raises:
        ConfigError: if there is no such preset, or a key is unknown, missing or wrong.
        DataError: if it cannot be read, or is not plain YAML.
    """
    plain = parse_yaml(preset_text(name_or_path), f"Preset {name_or_path}")
    try:
        return preset_from_dict(plain)
    except ConfigError as error:
        raise ConfigError(f"Preset {name_or_path}: {error}") from error


def preset_text(name_or_path: str | Path) -> str:
    """The YAML of a preset, with its comments, by its shipped name or from a file.

    Raises:
        ConfigError: if there is no such preset.
        DataError: if it cannot be read.
    """
    return read_text(find_preset(name_or_path))


def preset_from_dict(plain: Mapping[str, Any]) -> Preset:
    """The preset that `Preset.to_dict` described.

    Raises:
        ConfigError: if the solver is unknown, or a key is unknown, missing or of the wrong kind.
    """
    entries = dict(plain)
    solver = str(entries.pop("solver", None))
    if solver not in SOLVERS:
        raise ConfigError(f"solver = {one_line(solver, 80)} is not one of {', '.join(SOLVERS)}.")
    return SOLVERS[solver].from_dict(_with_parts(entries, _described))


def name_parts(plain: Mapping[str, Any]) -> dict[str, Any]:
    """What `Preset.to_dict` describes, with the names of a mixture's parts that are shipped presets."""
    return _with_parts(plain, _named)


def _with_parts(plain: Mapping[str, Any], change: Callable[[Any], Any]) -> dict[str, Any]:
    """A description with another preset in each of the parts of a mixture."""
    parts = plain.get("parts")
    if not isinstance(parts, list | tuple):
        return dict(plain)
    return {**plain, "parts": [_with_preset(part, change) for part in parts]}


def _with_preset(part: Any, change: Callable[[Any], Any]) -> Any:
    return part | {"preset": change(part["preset"])} if isinstance(part, dict) and "preset" in part else part


def _described(part: Any) -> Any:
    return load_preset(part).to_dict() if isinstance(part, str) else part


def _named(part: Any) -> Any:
    name = part.get("name") if isinstance(part, dict) else None
    return name if name in preset_names() and load_preset(name).to_dict() == part else part
