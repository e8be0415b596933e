"""Formats with a file per frame, in a folder per run, or with a file of many frames per run.

A reader is one subclass of `FrameFormat` with a function that yields the frames of a file. Files lie as

    data/train/run00/frame_000.vtk     splits of runs
    data/run00/frame_000.vtk           runs
    data/frame_000.vtk                 one run
    data/train/run00.lammpstrj         splits of files with many frames

Frames are in the order of the last numbers in their files' names, runs in the order of all numbers in theirs.

Of a folder's kinds of files, those of particles are read; boundary particles and surfaces are told by their names.
"""

from __future__ import annotations

import abc
import fnmatch
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, repeat
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm._support.bounded_files import starts_with
from nmpm._support.messages import counted
from nmpm._support.progress import progress_bar
from nmpm.data.convert.base import (
    ANY_NAME,
    EVERYTHING_UNKNOWN,
    Facts,
    ForeignDataset,
    Options,
    Reader,
    Run,
    find_split_name,
    is_selected,
    number_order,
    open_divided,
    placeholder_metadata,
)
from nmpm.data.convert.frames import Frame, FrameArrays, FrameLayout, FrameStack, flat_axes, join_frames
from nmpm.data.convert.named_arrays import plane_notes
from nmpm.data.format import SPLITS, Metadata, Trajectory, is_no_data
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
    particles = [kind for kind in points if not has_other_word(kind)] or points
    series = [kind for kind in particles if len(kinds[kind]) > 1]
    particles = series if len(particles) > 1 and series else particles
    if not particles and len(walls) == 1:
        particles, walls = walls, []
    if not particles:
        shown = ", ".join(f"{kind} ({problems[kind]})" for kind in list(kinds)[:4])
        raise DataError(f"{folder}: no file in it has particles: {shown}.")
    if len(particles) > 1:
        shown = ", ".join(f"{kind} ({len(kinds[kind])})" for kind in particles[:6])
        raise DataError(
            f"{folder}: files of {len(particles)} kinds may be the particles: {shown}. State which: --files"
            f" '{particles[0]}'; kinds that you list, as in --files '{','.join(particles[:2])}', join as materials."
            " (nmpm fit: --data.files.) If each kind is a run, give it a folder of its own."
        )
    names = {particles[0]: "", **dict.fromkeys(walls, WALL)}
    others = [f"{kind} ({problems[kind] or 'another kind of file'})" for kind in kinds if kind not in names]
    joined = f" with the boundary particles of {', '.join(walls)}" if walls else ""
    left_out = f" left out: {', '.join(others)};" if others else ""
    note = f"{folder}: the particles are {particles[0]}{joined};{left_out} others are read by --files PATTERN."
    return {kind: kinds[kind] for kind in names}, note


def has_only_other_words(name: str) -> bool:
    """Whether a name is one of grids, surfaces, walls and the like, and of nothing else."""
    return bool(words(name)) and words(name) <= _OTHER_WORDS | _WALL_WORDS | {"bodies"}


def has_other_word(name: str) -> bool:
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


_DEPTH = 3  # of folders
_FIRST_FRAMES = 10  # of a file with many, from which the layout is taken
_MISSING = 0.1  # part of a run's frames that may be missing


@dataclass(frozen=True)
class FrameFiles:
    """The files of a run: one with many frames, or a file per frame."""

    files: tuple[Path | None, ...]  # None where one is missing
    material: str = ""  # of the particles, where files of further materials belong to these
    beside: Mapping[Path, Sequence[tuple[str, Path]]] = field(default_factory=dict)  # these, with their materials


class FrameFormat(Reader):
    """Abstract reader of a format whose files contain one frame, or many, one subclass per format.

    Attributes:
        listings: Of the names of files that list the frames of a run; where there is one, others are only read by it.
    """

    listings: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def frames(self, file: Path) -> Iterator[Frame]:
        """Yields the frames of a file in order; raises a DataError that names it if it is damaged."""

    def count(self, file: Path) -> int:
        """Number of frames of a file with many."""
        return sum(1 for _ in self.frames(file))

    def notes(self, frames: Sequence[Frame], options: Options) -> tuple[str, ...]:  # noqa: ARG002 (for subclasses)
        """For the user, on the first frames of a run."""
        return ()

    def recognises(self, path: Path) -> bool:
        return next(self._folders(path), None) is not None

    def open(self, path: Path, options: Options) -> ForeignDataset:
        runs, gaps = self._runs(path)
        run = next((run for split in SPLITS for run in runs if run.split == split), runs[0])
        first = self._first_frames(run)
        layout, type_ids = FrameLayout.of(first), self._type_ids(first, runs)
        stated = {"bounds": first[0].box, "boundary": first[0].boundary}
        facts = {
            name: tuple(value[axis] for axis in layout.axes) for name, value in stated.items() if value is not None
        }
        names = {number: name for name, number in type_ids.items()}
        metadata = placeholder_metadata(len(layout.axes), particle_types=names, **facts)
        notes = [*plane_notes(layout.constant)]
        if layout.id_name:
            notes.append(f"Particles are matched by the array {layout.id_name!r}.")
        if layout.left_out:
            notes.append(f"Left out, as they are not numbers of all particles: {', '.join(layout.left_out)}.")
        notes += [*gaps, *self.notes(first, options)]
        steps = first[0].time is None and first[0].step is not None
        stated_facts = Facts(metadata, EVERYTHING_UNKNOWN - set(facts), tuple(notes), steps=steps)
        return open_divided({"all": runs}, stated_facts, partial(self._read_all, layout=layout), options)

    def first_files(self, path: Path) -> list[Path]:
        """The files of this format in the first folder that has any."""
        return next(self._folders(path), (path, []))[1]

    def _folders(self, path: Path) -> Iterator[tuple[Path, list[Path]]]:
        """Yields folders with files of this format and these files; of a file its own."""
        if path.is_file():
            if files := self._matching(path.parent, [path.name]):
                yield path.parent, files
            return
        for folder, inner, names in os.walk(path):
            names = [name for name in names if not is_no_data(name)]
            lists = next(filter(None, (fnmatch.filter(names, pattern) for pattern in self.listings)), [])
            inner.sort(key=lambda name: number_order(Path(name)))
            inner[:] = [name for name in inner if not is_no_data(name) and not lists]
            if len(Path(folder).relative_to(path).parts) >= _DEPTH:
                inner.clear()
            if files := self._matching(Path(folder), lists or names):
                yield Path(folder), sorted(files, key=number_order)

    def _matching(self, folder: Path, names: Sequence[str]) -> list[Path]:
        """The files of this format among those of a folder."""
        named = [name for name in names if any(fnmatch.fnmatch(name.lower(), pattern) for pattern in self.patterns)]
        files = [folder / name for name in named if is_selected(folder / name, self.selected)]
        by_content = self.signature and self.patterns == ANY_NAME
        return [file for file in files if starts_with(file, self.signature)] if by_content else files

    def _runs(self, path: Path) -> tuple[list[Run], list[str]]:
        """The runs in order, and notes on missing frames and on what is left out."""
        folders = dict(self._folders(path))
        if not folders:
            raise DataError(f"{path}: no file {' or '.join(self.selected or self.patterns)} there.")
        others = [] if self.selected else _other_folders(path, folders)
        folders = {folder: files for folder, files in folders.items() if folder not in others}
        # Whether files have many frames each, as the first one with particles tells.
        firsts = [kind[0] for kind in by_kind(next(iter(folders.values()))).values()]
        readable = firsts if len(firsts) == 1 else (file for file in firsts if not self._problem(file))
        many = any(len(list(islice(self.frames(file), 2))) > 1 for file in islice(readable, 1))
        if path.is_file() and not many:
            raise DataError(f"{path}: there is one frame in it. Give the folder of the frames.")
        runs, gaps, choices = list[Run](), list[str](), list[str]()
        for folder, files in folders.items():
            kinds: Kinds = by_kind(files)
            if len(kinds) > 1 and not self.selected:
                particles = [kind for kind in kinds if not has_only_other_words(kind)]
                if not many:
                    kinds, choice = choose_particles(folder, kinds, self._problem)
                    choices.append(choice)
                elif 0 < len(particles) < len(kinds) and any(files[0].match(pattern) for pattern in self.listings):
                    left_out = ", ".join(kind for kind in kinds if kind not in particles)
                    choices.append(f"{folder}: left out by their names: {left_out}; --files PATTERN reads them.")
                    kinds = {kind: kinds[kind] for kind in particles}
            if many:
                each = (file for inside in kinds.values() for file in inside)
                runs += [Run(file, 0, split=_split_of(file, path), source=FrameFiles((file,))) for file in each]
            else:
                runs.append(_run_of(kinds, folder, _split_of(folder, path), gaps))
        if many and len(runs) < 3:
            runs = [replace(run, frames=self.count(run.file)) for run in runs]
        notes = [
            f"{each[0]} The same in {counted(len(each) - 1, 'more run')}." if each[1:] else each[0]
            for each in (gaps, choices)
            if each
        ]
        if others:
            more = counted(len(others) - 1, "more folder")
            notes.append(f"{others[0]}: left out by its name, with {more}.")
        return runs, notes

    def _problem(self, file: Path) -> str:
        """Why a file has no particles; empty if it has."""
        try:
            frame = next(self.frames(file), None)
        except DataError as error:
            return str(error).removeprefix(f"{file}: ").rstrip(".")
        return "no frame" if frame is None else "a surface" if frame.surface else ""

    def _first_frames(self, run: Run) -> list[Frame]:
        """A few frames of a run with particles: the first of a file with many, else those of a few files."""
        files = [file for file in run.source.files if file is not None]
        if len(files) > 1:
            frames = [self._only_frame(file, run.source) for file in (*files[:2], files[-1])]
        else:
            frames = []
            for frame in islice(self.frames(files[0]), _FIRST_FRAMES):
                frames.append(frame)
                if len(frames) > 1 and not flat_axes(frames):
                    break
        inhabited = [frame for frame in frames if len(frame.position)]
        if not inhabited:
            raise DataError(f"{run.file}: there are no particles in its first frames.")
        return inhabited

    def _type_ids(self, first: Sequence[Frame], runs: Sequence[Run]) -> dict[str, int]:
        """Type ids by the names in the first frame of all runs, where types have names; those of the files, or new."""

        def ids(frame: Frame) -> dict[str, int]:
            arrays = FrameArrays.of(frame, range(frame.position.shape[1]), None)
            names = [] if arrays.type_names is None else arrays.type_names.tolist()
            return dict(zip(names, repeat(-1) if arrays.type is None else arrays.type.tolist(), strict=False))

        named = ids(first[0])
        if named:
            frames = [frame for run in runs for frame, _ in islice(self._frames_of(run), 1) if frame is not None]
            named = {name: number for frame in (*frames, *first) for name, number in ids(frame).items()}
        if set(named.values()) == {-1}:
            return {name: number for number, name in enumerate(sorted(named))}
        return named if len(set(named.values())) == len(named) else {}

    def _read_all(self, runs: Sequence[Run], metadata: Metadata, layout: FrameLayout) -> Iterator[Trajectory]:
        ids = {name: number for number, name in metadata.particle_types.items()}
        for run in runs:
            total = (run.frames if run.part is None else len(run.part)) or None
            stack = FrameStack(layout, ids, total)
            with progress_bar(f"Reading {run.file.name}", total) as advance:
                for frame, where in self._frames_of(run):
                    stack.add(frame, where)
                    advance()
            yield stack.trajectory(str(run.file))

    def _frames_of(self, run: Run) -> Iterator[tuple[Frame | None, str]]:
        """Yields the frames to take, None where one is missing, and where they are."""
        part = slice(None) if run.part is None else slice(run.part.start, run.part.stop)
        if len(run.source.files) == 1:
            for number, frame in islice(enumerate(self.frames(run.source.files[0])), part.start, part.stop):
                yield frame, f"{run.file}, frame {number}"
            return
        for file in run.source.files[part]:
            yield (None, "") if file is None else (self._only_frame(file, run.source), str(file))

    def _only_frame(self, file: Path, source: FrameFiles) -> Frame:
        try:
            frames = list(islice(self.frames(file), 2))
        except DataError as error:
            if file != source.files[-1]:
                raise
            raise DataError(
                f"{error} It is the last file of its run: if it is still being written, leave it out."
            ) from error
        if len(frames) != 1:
            number = "more than one frame" if frames else "no frame"
            raise DataError(f"{file}: there is {number} in it, but one in the first file.")
        beside = [(name, next(self.frames(other))) for name, other in source.beside.get(file, ())]
        return join_frames([(source.material, frames[0]), *beside]) if beside else frames[0]


def _other_folders(path: Path, folders: Mapping[Path, Sequence[Path]]) -> list[Path]:
    """Folders that are called as those of grids and surfaces are, with files whose names no other folder has."""
    others = [folder for folder in folders if folder != path and has_only_other_words(folder.name)]
    kinds = {kind for folder, files in folders.items() if folder not in others for kind in by_kind(files)}
    return [folder for folder in others if kinds and not kinds & by_kind(folders[folder]).keys()]


def _run_of(kinds: Kinds, folder: Path, split: str | None, gaps: list[str]) -> Run:
    """The run in a folder whose particles are in files of these kinds; those of the first tell the frames."""
    names, (first, *others) = material_names(kinds), kinds
    series = _series(folder, kinds[first], gaps)
    numbers = {other: np.array([_number(file) for file in kinds[other]]) for other in others}
    beside = {
        file: [
            (names[other], kinds[other][max(0, int(np.searchsorted(numbers[other], _number(file), side="right")) - 1)])
            for other in others
        ]
        for file in kinds[first]
    }
    return Run(folder, 0, len(series), split, source=FrameFiles(series, names[first], beside))


def _number(file: Path) -> int:
    match = NUMBER.search(stem(file))
    return int(match.group()) if match else 0


def _series(folder: Path, files: Sequence[Path], gaps: list[str]) -> tuple[Path | None, ...]:
    """The files of a folder in the order of their numbers, None where one is missing; adds a note on such gaps."""
    numbers = np.array([_number(file) for file in files])
    steps = np.diff(numbers)
    if len(files) < 3 or (steps == steps[0]).all():
        return tuple(files)
    values, counts = np.unique(steps, return_counts=True)
    step = int(values[counts.argmax()])
    after = files[int(np.argmax(steps != step))].name
    indices = (numbers - numbers[0]) // max(step, 1)
    missing = int(indices[-1]) + 1 - len(files)
    if steps.min() < 1 or (steps % step).any() or missing > _MISSING * len(files):
        gaps.append(f"{folder}: the numbers of files are uneven (first after {after}); their order counts.")
        return tuple(files)
    gaps.append(
        f"{folder}: {missing} of {len(files) + missing} frames are missing (first after {after}); no particle is there"
        " in these."
    )
    present = dict(zip(indices.tolist(), files, strict=True))
    return tuple(present.get(index) for index in range(len(files) + missing))


def _split_of(file: Path, path: Path) -> str | None:
    """The split that the name of the outermost folder, or of a file in it, begins with.

    Raises:
        DataError: if an inner folder is a split.
    """
    names = file.relative_to(path).parts
    splits = [find_split_name(*re.findall(r"[a-z]+", name.lower())[:1]) for name in names]
    if splits[1:-1].count(None) < len(splits[1:-1]) and splits[0] is None:
        raise DataError(f"{path}: there are datasets in its folders. Give one of them: {path / names[0]}.")
    return splits[0] if splits else None
