"""Presets by their shipped names, or from YAML files."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from nmpm._support.bounded_files import parse_yaml, read_text
from nmpm._support.messages import one_line, suggestion
from nmpm.errors import ConfigError
from nmpm.sim.mpm.mixture import MpmMixture
from nmpm.sim.mpm.preset import MpmPreset
from nmpm.sim.preset import Preset
from nmpm.sim.sph.preset import SphPreset

SOLVERS: dict[str, type[Preset]] = {kind.solver: kind for kind in (MpmPreset, MpmMixture, SphPreset)}


def preset_names() -> tuple[str, ...]:
    """Names of the shipped presets."""
    shipped = resources.files("nmpm.sim") / "presets"
    return tuple(sorted(i.name.removesuffix(".yaml") for i in shipped.iterdir() if i.name.endswith(".yaml")))


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
    path = Path(str(resources.files("nmpm.sim"))) / "presets" / f"{name_or_path}.yaml"
    if str(name_or_path) not in preset_names():
        path = Path(name_or_path)
    if not path.is_file():
        names = preset_names()
        raise ConfigError(
            f"There is no preset or file {name_or_path}; shipped presets: {', '.join(names)}."
            + suggestion(str(name_or_path), names)
        )
    return read_text(path)


def preset_from_dict(plain: Mapping[str, Any]) -> Preset:
    """The preset that `Preset.to_dict` described.

    Raises:
        ConfigError: if the solver is unknown, or a key is unknown, missing or of the wrong kind.
    """
    entries = dict(plain)
    solver = str(entries.pop("solver", None))
    if solver not in SOLVERS:
        raise ConfigError(f"solver = {one_line(solver, 80)} is not one of {', '.join(SOLVERS)}.")
    return SOLVERS[solver].from_dict(_with_parts_loaded(entries))


def _with_parts_loaded(entries: dict[str, Any]) -> dict[str, Any]:
    """The entries of a mixture with descriptions of its parts in place of their names."""
    parts = entries.get("parts")
    if not isinstance(parts, list | tuple):
        return entries
    loaded = [
        part | {"preset": load_preset(part["preset"]).to_dict()}
        if isinstance(part, dict) and isinstance(part.get("preset"), str)
        else part
        for part in parts
    ]
    return entries | {"parts": loaded}
