"""`nmpm render out.h5`: PNG and GIF of a trajectory."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.format import Split, Trajectory
    from nmpm.scene import Scene


def run(words: list[str]) -> None:
    """Run the command, e.g. ["render", "out.h5"]."""
    parser = argparse.ArgumentParser(
        prog="nmpm render", description="Draw a trajectory: snapshots as PNG, animation as GIF, beside the file."
    )
    parser.add_argument("file", type=Path, help="an HDF5 file, of nmpm rollout or of a dataset in the native layout")
    parser.add_argument("--trajectory", type=int, default=0, help="which trajectory (default: the first)")
    parser.add_argument("--family", help="what type ids mean where metadata.json does not say: deepmind, lagrangebench")
    parser.add_argument("--out", type=Path, help="name of the pictures, without ending (default: that of the file)")
    chosen = parser.parse_args(words[1:])
    from nmpm.data.format import Split

    split = Split(chosen.file)
    if not 0 <= chosen.trajectory < len(split):
        raise ConfigError(f"--trajectory {chosen.trajectory}: {chosen.file} holds trajectories 0 … {len(split) - 1}.")
    _draw(split, chosen.trajectory, chosen.family, chosen.out or chosen.file.with_suffix(""))


def _draw(split: Split, index: int, family: str | None, stem: Path) -> None:
    from nmpm.viz import Exhibit, animation, material_names, snapshots

    trajectory = split.read(index)
    scene, names, static = _facts(split, trajectory, family)
    moving = ~np.isin(trajectory.particle_type, sorted(static))
    label = "prediction" if "predicted" in str(trajectory.attributes.get("generator", "")) else "recorded"
    exhibit = Exhibit(
        rows={label: trajectory.position[:, moving]},
        material=material_names(trajectory.particle_type[moving], names),
        bounds=scene.bounds,
        dt=scene.dt,
        domain=scene.domain,
        obstacle=trajectory.position[0, ~moving],
        periodic=scene.periodic,
        gravity=scene.gravity,
    )
    for suffix, draw in ((".png", snapshots), (".gif", animation)):
        target = stem.with_name(stem.name + suffix)
        draw(exhibit, target)
        sys.stdout.write(f"wrote {target}\n")


def _facts(split: Split, trajectory: Trajectory, family: str | None) -> tuple[Scene, dict[int, str], frozenset[int]]:
    """Scene, names of the type ids and static ids: from the trajectory itself if a rollout wrote it, else metadata."""
    from nmpm.data.format import read_metadata
    from nmpm.data.scene_inference import infer_scene
    from nmpm.scene import Scene

    if "scene" in trajectory.attributes:
        names = json.loads(trajectory.attributes["particle_types"])
        static = frozenset(int(number) for number in trajectory.attributes["static_types"])
        scene = Scene.from_dict(json.loads(trajectory.attributes["scene"]))
        return scene, {int(number): name for number, name in names.items()}, static
    metadata = read_metadata(split.path.parent, family)
    return infer_scene(split.path.parent, family), dict(metadata.particle_types), metadata.static_types
