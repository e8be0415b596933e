"""The text of a new configuration: YAML with a comment on each value that depends on the data."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterator, Sequence

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined

from nmpm.data.facts import FOUND
from nmpm.data.new_configuration.choice import OPTIONS, Choice, CompletedSource
from nmpm.scene import Scene

FEW = 100
"""Training trajectories below which mirror images are worth their doubled variety."""
LONG = 40.0
"""Minutes from which the learning rate is halved: trainings of hours may diverge at 6e-3."""
LARGE = 4000
"""Particles from which evaluations and buffers hold fewer trajectories."""
_CROWDED = 1.8  # volume fraction of late cells from which a density cap is worth it
_OFF_CENTRE = 0.25  # cells by which walls may lie off their mirror image
_BUFFER_BYTES = 1e9
_WIDTH = 118

_TRIVIAL = {"particle_types", "sequence_length"}  # of which the title and the data say as much

Entry = tuple[str, str]
"""A value as YAML, and a comment."""


def render_configuration(path: str, source: CompletedSource, choice: Choice, root: str) -> str:
    """The YAML of a configuration.

    Args:
        path: The dataset, as the user names it.
        source: The dataset.
        choice: The grid for it.
        root: Folder of the run's files.
    """
    survey, machine, size = choice.survey, choice.machine, choice.size
    steps = _two_digits(1.25 * 0.9 * 60 * machine.minutes / choice.cost.seconds)
    environment = Environment(
        loader=PackageLoader("nmpm.data.new_configuration"),
        undefined=StrictUndefined,
        trim_blocks=True,
        autoescape=False,  # noqa: S701 (YAML)
    )
    return environment.get_template("configuration.yaml").render(
        title=_title(path, choice),
        root=_scalar(root),
        steps=steps,
        pace=f"{choice.cost.seconds:.2g} s a step here; a quarter more than the time holds, which ends it",
        time=_duration(machine.minutes),
        validated="valid" in survey.counts,
        interval=_duration(machine.minutes / 5),
        cells=_cells(choice),
        grid=_grid(choice),
        frames=choice.frames,
        unroll=size.unroll,
        width=size.width,
        constraints=_constraints(choice),
        energy=f"energy: not limited, as {choice.fed}" if choice.fed else "energy does not rise in the data",
        rate="3.0e-3" if machine.minutes >= LONG else "6.0e-3",
        augmentation=_augmentation(choice),
        path=_scalar(path),
        facts=_facts(source),
        remarks=[line for remark in _remarks(source, choice) for line in _wrapped(remark)],
        batch_size=size.batch_size,
        sampling=_sampling(choice),
    )


def _title(path: str, choice: Choice) -> list[str]:
    scene, survey = choice.scene, choice.survey
    counts = ", ".join(f"{number} {name}" for name, number in survey.counts.items())
    materials = "" if scene.materials == ("particles",) else f" of {', '.join(scene.materials)}"
    return _wrapped(
        f"{path}: trajectories in {scene.dim}-D, {counts}, of up to {survey.particles} particles{materials}. Written by"
        f" nmpm init for a training of {choice.machine.minutes:.3g} minutes. Each key is explained in tutorial.yaml"
        " (nmpm --help)."
    )


def _cells(choice: Choice) -> str:
    longest = max(high - low for low, high in choice.scene.domain)
    square = tuple(round(choice.grid.cells * (high - low) / longest) for low, high in choice.scene.domain)
    return str(choice.grid.cells) if choice.grid.shape == square else str(list(choice.grid.shape))


def _grid(choice: Choice) -> str:
    memory = f"; {choice.cost.memory / 1e9:.2g} GB of memory" if choice.scene.dim == 3 else ""
    grid = choice.grid
    return f"{grid.per_cell:.2g} particles per occupied cell, up to {grid.high_speed:.2g} cells a frame{memory}"


def _constraints(choice: Choice) -> str:
    if choice.fed:
        return "{energy: false, rest_speed: 0.0}"
    speed = 0.01 if choice.survey.settles else choice.cells_per_frame(choice.survey.late_speed) / 4
    parts = [f"energy: true, rest_speed: {min(max(speed, 0.0025), 0.01):.2g}"]
    crowding = choice.survey.crowding(choice.scene, choice.grid.shape)
    if crowding > _CROWDED and not choice.survey.settles:
        parts.append(f"density_cap: {1.1 * crowding:.1f}")
    return f"{{{', '.join(parts)}}}"


def _augmentation(choice: Choice) -> dict[str, Entry]:
    entries = {}
    axes = [axis for axis in range(choice.scene.dim) if _mirrors(choice, axis)]
    if axes and choice.survey.counts.get("train", 0) < FEW:
        entries["mirror"] = (str(axes), "few trajectories: mirror images double them")
    if choice.transient and choice.scene.bounds != choice.scene.domain:
        entries["jitter"] = (
            "0.35",
            "cells by which the grid is moved at most: where cells lie should matter little",
        )
    if choice.scene.evolving:
        entries["field_weight"] = ("1.0", f"of the error of {', '.join(choice.scene.evolving)}, beside positions")
    return entries


def _mirrors(choice: Choice, axis: int) -> bool:
    scene = choice.scene
    (low, high), (outer_low, outer_high) = scene.bounds[axis], scene.domain[axis]
    off_centre = abs(choice.cells_per_frame(low + high - outer_low - outer_high))
    falls = scene.gravity is None or (scene.gravity[axis] != 0 and not scene.gravity_varies)
    return not falls and not choice.fed and off_centre < _OFF_CENTRE


def _facts(source: CompletedSource) -> dict[str, Entry]:
    """Options of the datamodule, by which the user, or what was found, completes the metadata."""
    given = {name: getattr(source.data.options, name) for name in OPTIONS}
    return {
        name: (json.dumps(value, default=sorted), source.hows.get(name, "as given"))
        for name, value in given.items()
        if value is not None
    }


def _remarks(source: CompletedSource, choice: Choice) -> Iterator[str]:
    """Facts and how they were found, then advice."""
    scene, metadata = choice.scene, source.data.metadata
    yield f"dt {metadata.dt:g}; gravity {_gravity(scene)}; bounds {_box(scene.bounds)}, {', '.join(scene.boundary)}"
    stated = metadata.extra.get(FOUND)
    for name, how in stated.items() if isinstance(stated, dict) else ():
        if name not in _TRIVIAL and (not name.endswith("_types") or getattr(metadata, name, None)):
            yield f"{name}: {how}"
    if not scene.gravity_known:
        yield "Without a known gravity none is added to what the network predicts; a key gravity here states it."


def _gravity(scene: Scene) -> str:
    if scene.gravity_varies:
        return "of each trajectory's own"
    return "not known" if scene.gravity is None else ", ".join(f"{g:.6g}" for g in scene.gravity)


def _box(box: Sequence[tuple[float, float]]) -> str:
    return " x ".join(f"{low:.5g}…{high:.5g}" for low, high in box)


def _sampling(choice: Choice) -> dict[str, Entry]:
    survey, entries = choice.survey, dict[str, Entry]()
    held = int(_BUFFER_BYTES / (12 * choice.scene.dim * survey.particles * survey.frames))
    if held < 16:
        entries["buffer_size"] = (str(max(held, 2)), "trajectories in memory")
    if survey.counts.get("train", 0) > min(held, 16):
        entries["passes"] = (
            "0.1" if survey.particles > LARGE else "0.2",
            "a short training should see all trajectories",
        )
    if survey.settles:
        entries["emphasis"] = ("0.7", "the scenes come to rest; windows of rest teach little")
    elif choice.transient:
        entries["openings"] = ("0.3", "of the windows start where rollouts do: early errors decide the rest")
    if survey.particles > LARGE:
        entries["eval_batch_size"] = ("2", "trajectories rolled out together")
    return entries


def _scalar(text: str) -> str:
    return yaml.safe_dump(text, width=math.inf, allow_unicode=True).splitlines()[0]


def _two_digits(number: float) -> int:
    unit: int = 10 ** max(0, math.floor(math.log10(max(number, 1))) - 1)
    return math.ceil(number / unit) * unit


def _duration(minutes: float) -> str:
    seconds = math.ceil(60 * minutes)
    return f"{seconds // 86400:02d}:{seconds // 3600 % 24:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(" ".join(text.split()), _WIDTH - 4, subsequent_indent="  ")
