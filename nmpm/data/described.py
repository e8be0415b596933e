"""Trajectories that bring the facts of their scene along, as attributes, where no `metadata.json` is beside them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.data.metadata import scene_metadata
from nmpm.data.metadata_json import JsonKeys, parse_ids, parse_json, parse_names
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

DESCRIPTION = ("scene", "particle_types", "static_types", "prescribed_types")
"""Names of these attributes."""


def description(trajectory: Trajectory, metadata: Metadata, particle_volume: float) -> dict[str, Any]:
    """The attributes `scene`, `particle_types`, in JSON, and ids of types of a trajectory of a dataset."""
    types = np.unique(trajectory.particle_type).tolist()
    scene = Scene(
        bounds=metadata.bounds,
        domain=metadata.domain or metadata.bounds,
        dt=metadata.dt,
        materials=tuple(dict.fromkeys(metadata.particle_types[i] for i in metadata.moving_types if i in types)),
        particle_volume=particle_volume,
        boundary=metadata.boundary,
        gravity=metadata.gravity,
        gravity_varies="gravity" in trajectory.attributes,
        obstacles=bool(metadata.obstacle_types & set(types)),
        moving_obstacles=bool(metadata.prescribed_types & set(types)),
    )
    prescribed = np.array(sorted(metadata.prescribed_types), dtype=np.int64)
    return ({"prescribed_types": prescribed} if len(prescribed) else {}) | {
        "scene": json.dumps(scene.to_dict()),
        "particle_types": json.dumps(metadata.particle_types),
        "static_types": np.array(sorted(metadata.static_types), dtype=np.int64),
    }


def read_description(
    attributes: Mapping[str, Any], path: Path
) -> tuple[Scene, dict[int, str], frozenset[int], frozenset[int]]:
    """The scene, the names of the type ids, the ids that do not move, and those that move as prescribed.

    Of a trajectory with a description.

    Raises:
        DataError: naming the file, if an attribute is missing or wrong.
    """
    texts = {key: attributes.get(key) for key in ("scene", "particle_types")}
    if wrong := [key for key, text in texts.items() if not isinstance(text, str)]:
        raise DataError(f"{path}: the attribute {wrong[0]} of a prediction should be a text, in JSON.")
    plain, names = (parse_json(str(text), f"{path}, {key}") for key, text in texts.items())
    static = np.asarray(attributes.get("static_types")).tolist()
    prescribed = np.asarray(attributes.get("prescribed_types", [])).tolist()
    keys = JsonKeys(path, {"particle_types": names, "static_types": static, "prescribed_types": prescribed})
    try:
        scene = Scene.from_dict(plain)
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from error
    ids = (keys.take(key, parse_ids) for key in ("static_types", "prescribed_types"))
    return scene, keys.take("particle_types", parse_names), *ids


def described_metadata(attributes: Mapping[str, Any], path: Path, frames: int) -> Metadata:
    """The metadata of a dataset of trajectories with this description, of so many frames; see `read_description`."""
    scene, names, static, prescribed = read_description(attributes, path)
    return replace(
        scene_metadata(scene, names, None),
        sequence_length=frames - 1,
        static_types=static,
        prescribed_types=prescribed,
        fields=(),  # a description declares no inputs of models
    )
