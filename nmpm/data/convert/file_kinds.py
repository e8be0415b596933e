"""Kinds of files in the folder of a run: the particles', walls of boundary particles, and others, such as surfaces."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from nmpm.data.convert.base import number_order
from nmpm.errors import DataError

NUMBER = re.compile(r"\d{1,18}(?!.*\d)")
"""The last number of a name: that of the frame."""

WALL = "wall"
"""Name of the material of boundary particles."""

_WALL_WORDS = frozenset({"bound", "boundary", "boundaries", "wall", "walls"})
_OTHER_WORDS = frozenset(
    {
        "bbox", "bond", "bonds", "bounding", "box", "cell", "cells", "chain", "chains", "contact", "contacts",
        "container", "domain", "facet", "facets", "force", "forces", "geometry", "grid", "grids", "interaction",
        "interactions", "intr", "intrs", "isosurface", "mesh", "meshes", "node", "nodes", "obstacle", "obstacles",
        "pair", "pairs", "rb", "rigid", "stl", "surface", "surfaces",
    }
)  # fmt: skip

Kinds = Mapping[str, Sequence[Path]]
"""Files by their names, in which * replaces the last number."""


def by_kind(files: Iterable[Path]) -> dict[str, list[Path]]:
    """Files whose names differ in their last number only, in the order of the numbers."""
    kinds: dict[str, list[Path]] = {}
    for file in sorted(files, key=number_order):
        kinds.setdefault(NUMBER.sub("*", stem(file)) + file.name[len(stem(file)) :], []).append(file)
    return kinds


def stem(file: Path) -> str:
    """A name without its suffixes, such as `.vtk` or `.lammpstrj.gz`; that of `dump.500` is whole."""
    return re.sub(r"(\.[A-Za-z]\w*){1,2}$", "", file.name)


def choose_particles(folder: Path, kinds: Kinds, problem: Callable[[Path], str]) -> tuple[Kinds, str]:
    """The files of particles and of boundary particles, by material, and a note on the others.

    Args:
        folder: Of the files.
        kinds: All files of the format in it.
        problem: Says why a file has no particles; empty if it has.

    Raises:
        DataError: if more than one kind may be the particles, or none.
    """
    problems = {kind: problem(files[0]) for kind, files in kinds.items()}
    walls = [kind for kind in kinds if words(kind) & _WALL_WORDS and not problems[kind]]
    points = [kind for kind in kinds if kind not in walls and not problems[kind]]
    particles = [kind for kind in points if not words(kind) & _OTHER_WORDS] or points
    series = [kind for kind in particles if len(kinds[kind]) > 1]
    particles = series if len(particles) > 1 and series else particles
    if not particles and len(walls) == 1:
        particles, walls = walls, []
    if len(particles) != 1:
        raise DataError(f"{folder}: {_which(kinds, particles, problems)}")
    names = {particles[0]: "", **dict.fromkeys(walls, WALL)}
    others = [f"{kind} ({problems[kind] or 'another kind of file'})" for kind in kinds if kind not in names]
    joined = f" with the boundary particles of {', '.join(walls)}" if walls else ""
    left_out = f" left out: {', '.join(others)};" if others else ""
    note = f"{folder}: the particles are {particles[0]}{joined};{left_out} others are read by --files PATTERN."
    return {kind: kinds[kind] for kind in names}, note


def keep_particles(folder: Path, kinds: Kinds) -> tuple[Kinds, str]:
    """The lists of frames but for those that are called as walls, surfaces and the like are, and a note on these."""
    particles = {kind: files for kind, files in kinds.items() if not _only_others(kind)}
    others = ", ".join(kind for kind in kinds if kind not in particles)
    if not particles or not others:
        return kinds, ""
    return particles, f"{folder}: left out by their names: {others}; --files PATTERN reads them."


def other_folders(path: Path, folders: Mapping[Path, Sequence[Path]]) -> list[Path]:
    """Folders that are called as those of grids and surfaces are, with files whose names no other folder has."""
    others = [folder for folder in folders if folder != path and _only_others(folder.name)]
    kinds = {kind for folder, files in folders.items() if folder not in others for kind in by_kind(files)}
    return [folder for folder in others if kinds and not kinds & by_kind(folders[folder]).keys()]


def _only_others(name: str) -> bool:
    return bool(words(name)) and words(name) <= _OTHER_WORDS | _WALL_WORDS | {"bodies"}


def is_other_name(name: str) -> bool:
    """Whether a word of a name is one of grids, surfaces and the like."""
    return bool(words(name) & _OTHER_WORDS)


def material_names(kinds: Iterable[str]) -> dict[str, str]:
    """Names of materials by kinds: what tells their names from each other; all walls are called so."""
    kinds = list(kinds)
    ordered = {kind: [word.lower() for word in _words(Path(kind).stem)] for kind in kinds}
    shared = set.intersection(*map(set, ordered.values())) if len(kinds) > 1 else set[str]()
    names = {kind: "_".join(word for word in ordered[kind] if word not in shared) or "particles" for kind in kinds}
    names = {kind: WALL if words(kind) & _WALL_WORDS else name for kind, name in names.items()}
    repeated = len({name for name in names.values() if name != WALL}) < sum(name != WALL for name in names.values())
    return {kind: kind if repeated and name != WALL else name for kind, name in names.items()}


def words(name: str) -> set[str]:
    """The words of a name, without its suffix, in lower case."""
    return {word.lower() for word in _words(re.sub(r"\.[A-Za-z]\w*$", "", name))}


def _words(text: str) -> list[str]:
    return re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", text)


def _which(kinds: Kinds, particles: Sequence[str], problems: Mapping[str, str]) -> str:
    shown = ", ".join(f"{kind} ({len(kinds[kind])})" for kind in list(particles or kinds)[:6])
    if not particles:
        return f"no file in it has particles: {', '.join(f'{kind} ({problems[kind]})' for kind in list(kinds)[:4])}."
    first, *_ = particles
    return (
        f"files of {len(particles)} kinds may be the particles: {shown}. State which: --files '{first}'; kinds that"
        f" you list, as in --files '{','.join(particles[:2])}', join as materials. (nmpm fit: --data.files.) If each"
        " kind is a run, give it a folder of its own."
    )
