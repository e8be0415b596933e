"""DeepMind's Learning-to-Simulate datasets: TFRecord files beside a `metadata.json`, read without TensorFlow.

Sanchez-Gonzalez et al., "Learning to simulate complex physics with graph networks", 2020. A record is one trajectory:
context features `particle_type` (N int64 in one string) and `key`, and per frame `position` (N·D float32 in one
string), in some datasets with further lists such as `step_context` or `force`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm.data.convert.base import FileFormat, Options, located
from nmpm.data.convert.tfrecord import Feature, SequenceExample, read_record, record_offsets
from nmpm.data.format import METADATA_FILE, Metadata, Trajectory, read_metadata
from nmpm.errors import DataError


class DeepMind(FileFormat):
    """TFRecord files with a `metadata.json` beside them."""

    name: ClassVar[str] = "deepmind"
    summary: ClassVar[str] = "DeepMind's TFRecord files with metadata.json (Learning to Simulate)"
    pattern: ClassVar[str] = "*.tfrecord"

    def metadata(self, file: Path, options: Options) -> tuple[Metadata, tuple[str, ...]]:
        return read_metadata(file.parent, options.family or self.family), ()

    def count(self, file: Path) -> int:
        return len(record_offsets(file))

    def read(self, file: Path, metadata: Metadata, options: Options) -> Iterator[Trajectory]:  # noqa: ARG002
        for index, offset in enumerate(record_offsets(file)):
            yield _trajectory(read_record(file, offset, index), metadata.dim, f"{file}: record {index}")


def _trajectory(example: SequenceExample, dim: int, where: str) -> Trajectory:
    if "position" not in example.steps or "particle_type" not in example.context:
        features = ", ".join(sorted({*example.context, *example.steps})) or "nothing"
        raise DataError(f"{where}: needs the features `particle_type` and `position`; found {features}.")
    particle_type = _numbers(example.context["particle_type"], np.dtype("<i8"), f"{where}, particle_type")
    particles = len(particle_type)
    frames = [_numbers(step, np.dtype("<f4"), f"{where}, position") for step in example.steps["position"]]
    wrong = [i for i, frame in enumerate(frames) if len(frame) != particles * dim]
    if wrong or not frames or not particles:
        got = f"; frame {wrong[0]} has {len(frames[wrong[0]])}" if wrong else ""
        raise DataError(
            f"{where}: {len(frames)} frames, {particles} particles: each frame needs {particles} x {dim} numbers{got}."
            f" Is `dim` of {METADATA_FILE} right?"
        )
    attributes = {k: _attribute(v) for k, v in example.context.items() if k != "particle_type" and len(v)}
    fields = {
        name: _field(steps, particles, dim, f"{where}, {name}")
        for name, steps in example.steps.items()
        if name != "position"
    }
    with located(where):
        position = np.stack(frames).reshape(len(frames), particles, dim)
        return Trajectory(position, particle_type, attributes, fields)


def _numbers(feature: Feature, kind: np.dtype[Any], where: str) -> np.ndarray:
    """A feature's numbers, which may be packed into one string."""
    if isinstance(feature, np.ndarray):
        return feature
    if len(feature) != 1 or len(feature[0]) % kind.itemsize:
        sizes = [len(part) for part in feature[:8]]
        raise DataError(
            f"{where}: expected one string of {kind.itemsize}-byte numbers; found strings of {sizes} bytes."
        )
    return np.frombuffer(feature[0], kind)


def _attribute(feature: Feature) -> object:
    if isinstance(feature, np.ndarray):
        return feature.item() if feature.size == 1 else feature
    return np.bytes_(feature[0]) if len(feature) == 1 else np.array(feature)


def _field(steps: list[Feature], particles: int, dim: int, where: str) -> np.ndarray:
    """(T, k) numbers per frame; (T, N, D) where k is N·D."""
    rows = [_numbers(step, np.dtype("<f4"), where) for step in steps]
    if len({len(row) for row in rows}) > 1:
        raise DataError(
            f"{where}: frames have {min(map(len, rows))} to {max(map(len, rows))} numbers; all need equally many."
        )
    values = np.stack(rows) if rows else np.empty((0, 0), np.float32)
    return values.reshape(len(values), particles, dim) if values.shape[1] == particles * dim else values
