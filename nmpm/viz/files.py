"""Labelled trajectories from files: rollouts as `nmpm rollout` writes them, and datasets in the native format."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from nmpm.data.convert import Options
from nmpm.data.fields import read_fields
from nmpm.data.format import MEMBER, TRUTH, Metadata, Split, Trajectory, read_metadata
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.predictions import read_description
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import DataError
from nmpm.scene import Scene
from nmpm.viz.trajectories import Floats, LabelledTrajectories, material_names

TOLERANCE = 1e-3
"""Share of the box by which first frames may differ where one file is the prediction of the other."""
MEMBER_TOLERANCE = 3e-2
"""The same where that is an ensemble, whose members may start from nudged positions."""


def read_labelled(split: Split, index: int = 0, family: str | None = None) -> LabelledTrajectories:
    """Reads a trajectory, labelled "prediction" or "recorded" (or "simulated", where nmpm's simulators made it).

    A prediction that has its truth beside it comes after that, over the frames that both have. One that is a member of
    an ensemble, see `member_indices`, has the others as further members, over the frames that all have.
    With the fields of particles that the file's scene or metadata declare, see `nmpm.data.fields`.

    Args:
        split: The file.
        index: Of the trajectory.
        family: Meaning of type ids if the folder's metadata.json lacks it.

    Raises:
        DataError: if there is no such trajectory, or file or metadata cannot be read.
    """
    if not 0 <= index < len(split):
        raise DataError(f"{split.path} contains trajectories 0 … {len(split) - 1}, not {index}.")
    trajectory = split.read(index)
    scene, metadata, source = _describe(split, trajectory, family)
    names = metadata.particle_types
    others = _read_further_members(split, index, trajectory)
    label = f"member {trajectory.attributes[MEMBER]}" if others else source
    moving = ~metadata.is_static(trajectory.particle_type)
    fields = read_fields(split, index, scene.particle_fields)
    position = trajectory.position
    positions = {label: position}
    truth = split.fields(index).get(TRUTH) if source == "prediction" else None
    if truth is not None:
        if truth.dtype.kind not in "iuf" or truth.ndim != 3 or truth.shape[1:] != position.shape[1:] or not len(truth):
            raise DataError(
                f"{split.where(index)}: truth has the shape {truth.shape} and the type {truth.dtype}, beside positions"
                f" of the shape {position.shape}. Both should be (frames, particles, dimensions) of the same particles."
            )
        positions = {TRUTH: truth, label: position}
    frames = min(len(each) for each in (*positions.values(), *others.values()))
    return LabelledTrajectories(
        positions={name: position[:frames, moving] for name, position in positions.items()},
        material=material_names(trajectory.particle_type[moving], names),
        bounds=scene.bounds,
        dt=scene.dt,
        domain=scene.domain,
        obstacle=trajectory.position[0, ~moving],
        periodic=scene.periodic,
        gravity=trajectory_gravity(trajectory.attributes, scene, f"{split.path}, trajectory {index}"),
        title=_title(split, index, material_names(trajectory.particle_type[moving], names), len(others)),
        fields={name: {label: values[:frames, moving]} for name, values in fields.items() if values.shape[1] > 1},
        prescribed=frozenset(names[number] for number in metadata.prescribed_types),
        further_members={name: position[:frames, moving] for name, position in others.items()},
        densities=dict(zip(scene.materials, scene.densities, strict=False)),
    )


def _title(split: Split, index: int, materials: NDArray[np.str_], others: int) -> str:
    """Model, or folder and file, and which scene: "waterramps: 1,620 particles of water"."""
    _, predicted, model = str(split.attributes(index).get("generator", "")).partition("predicted by ")
    source = (
        model.removeprefix("the zoo model ") if predicted else f"{split.path.resolve().parent.name}/{split.path.name}"
    )
    number = f", trajectory {index}" if len(split) > others + 1 else ""
    kinds = ", ".join(dict.fromkeys(materials.tolist()))
    return f"{source}{number}: {len(materials):,} particles of {kinds}" + (f", {others + 1} members" if others else "")


def member_indices(split: Split, index: int) -> range:
    """The trajectories of the ensemble that one belongs to: neighbours whose attribute `member` counts up by one.

    Only itself where it is no member of an ensemble.
    """
    first = last = index
    number = _member_number(split, index)
    while number is not None and first > 0 and _member_number(split, first - 1) == number - (index - first) - 1:
        first -= 1
    while number is not None and last + 1 < len(split) and _member_number(split, last + 1) == number + last + 1 - index:
        last += 1
    return range(first, last + 1)


def _member_number(split: Split, index: int) -> int | None:
    number = split.attributes(index).get(MEMBER)
    return int(number) if isinstance(number, int | np.integer) else None


def _read_further_members(split: Split, index: int, trajectory: Trajectory) -> dict[str, Floats]:
    """Positions (T', N, D) of the other members of a trajectory's ensemble; a DataError for other particles."""
    others = {}
    for number in member_indices(split, index):
        if number == index:
            continue
        other = split.read(number)
        if not np.array_equal(other.particle_type, trajectory.particle_type):
            raise DataError(
                f"{split.where(number)}: member {other.attributes[MEMBER]} has other particles than member"
                f" {trajectory.attributes[MEMBER]}: {len(other.particle_type)} and {len(trajectory.particle_type)}, or"
                " of other types. Members of an ensemble are rollouts of the same particles."
            )
        others[f"member {other.attributes[MEMBER]}"] = other.position
    return others


def label_trajectory(
    trajectory: Trajectory, label: str, metadata: Metadata, scene: Scene, title: str
) -> LabelledTrajectories:
    """One trajectory of a dataset, to be drawn; raises a DataError if a position or its gravity is wrong."""
    types = trajectory.particle_type
    moving, static = metadata.is_moving(types), metadata.is_static(types)
    moving = moving | np.isin(types, list(metadata.prescribed_types))
    return LabelledTrajectories(
        positions={label: trajectory.position[:, moving]},
        material=material_names(types[moving], metadata.particle_types),
        bounds=scene.bounds,
        dt=scene.dt,
        domain=scene.domain,
        obstacle=trajectory.position[0, static],
        periodic=scene.periodic,
        gravity=trajectory_gravity(trajectory.attributes, scene, title),
        title=title,
    )


def combine(
    reference: LabelledTrajectories, other: LabelledTrajectories, names: tuple[str, str]
) -> LabelledTrajectories:
    """Two trajectories of the same particles, over the frames that both have.

    Args:
        reference: What errors are against.
        other: What is compared with it.
        names: Where they come from, for messages, and as labels where both have the same.

    Raises:
        DataError: if their particles differ in number, material or first position.
    """
    # The last of each: a prediction comes after its truth.
    (first_label, first), (second_label, second) = (list(each.positions.items())[-1] for each in (reference, other))
    both = f"{names[0]} and {names[1]}"
    if first.shape[1:] != second.shape[1:]:
        raise DataError(
            f"{both} do not show the same particles: {first.shape[1]} moving ones in {first.shape[2]}-D, and"
            f" {second.shape[1]} in {second.shape[2]}-D."
        )
    if not np.array_equal(reference.material, other.material):
        raise DataError(f"{both} do not show the same particles: their materials differ.")
    sides = np.ptp(np.array(reference.outer_bounds), axis=1)
    apart = float(np.nan_to_num(np.abs((first[0] - second[0]) / sides)).max())
    if apart > (MEMBER_TOLERANCE if other.further_members else TOLERANCE):
        raise DataError(
            f"{both} do not start at the same positions: a particle is {apart:.2g} of the box's side apart. Is it the"
            " same trajectory? --truth-trajectory chooses another."
        )
    frames = min(len(first), len(second))
    labels = (first_label, second_label) if first_label != second_label else names
    fields = {
        name: {
            label: next(iter(each.fields[name].values()))[:frames]
            for label, each in zip(labels, (reference, other), strict=True)
            if name in each.fields
        }
        for name in dict.fromkeys((*reference.fields, *other.fields))
    }
    return dataclasses.replace(
        reference,
        positions={labels[0]: first[:frames], labels[1]: second[:frames]},
        title=other.title,
        fields=fields,
        further_members={label: position[:frames] for label, position in other.further_members.items()},
    )


def _describe(split: Split, trajectory: Trajectory, family: str | None) -> tuple[Scene, Metadata, str]:
    """Scene and metadata, of a prediction's attributes or else of metadata.json, and label."""
    attributes = trajectory.attributes
    if "scene" in attributes:
        predicted = "predicted by" in str(attributes.get("generator"))
        return *read_description(attributes, split.path, split.frames(0)), "prediction" if predicted else "recorded"
    metadata, scene = read_metadata(split.path.parent, family), infer_scene(split.path.parent, Options(family))
    simulated = str(metadata.extra.get("generator", "")).startswith("nmpm")
    return scene, metadata, "simulated" if simulated else "recorded"
