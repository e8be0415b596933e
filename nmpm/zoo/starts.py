"""Starts of rollouts from scenes and recordings, and their predictions: timed, written as recorded, compared."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
import torch

from nmpm._support.progress import progress_bar
from nmpm.data.catalog import find_data
from nmpm.data.convert import native_file
from nmpm.data.convert.native import file_metadata, with_family
from nmpm.data.dataset import Dataset
from nmpm.data.format import METADATA_FILE, Metadata, Split, Trajectory
from nmpm.data.gravity import check_gravity, trajectory_gravity
from nmpm.data.metadata import FOUND
from nmpm.data.predictions import predicted_trajectory
from nmpm.data.recordings import SplitRecordings
from nmpm.data.sources import FolderSource
from nmpm.data.stated import Options
from nmpm.data.volumes import VOLUME
from nmpm.data.windows import collate
from nmpm.emulator import Prescribed, Rollout, RolloutOptions, stream_rollout
from nmpm.emulator.fields import warn_of_ignored
from nmpm.emulator.monitor import Monitor, warn_of_start_outside
from nmpm.errors import ConfigError
from nmpm.evaluation.machine import Clock
from nmpm.particles import Particles, Window
from nmpm.scene import Reading, Scene, is_same_volume
from nmpm.zoo import Pretrained
from nmpm.zoo.matching import match_data
from nmpm.zoo.states import is_gravity_of


@dataclass(frozen=True)
class Start:
    """What a rollout starts from, and how it is written.

    Args:
        model: The model, matched to the data where they are of another kind.
        scene: Of what is written.
        state: That the model starts from, in its materials.
        written: The same in the materials and at the frames that are written.
        recorded: What was recorded, at the frames that are written; None without frames to compare with.
        prescribed: What moves or enters as recorded.
        between: Frames of the model per written frame.
        as_recorded: Gives a prediction the ids and types that its particles have in the data.
        source: File and trajectory, in words.
    """

    model: Pretrained
    scene: Scene
    state: Particles
    written: Particles
    recorded: Window | None = None
    prescribed: Prescribed | None = None
    between: int = 1
    as_recorded: Callable[[Trajectory], Trajectory] = lambda trajectory: trajectory
    source: str = ""

    def on_device(self) -> tuple[Particles, Prescribed | None]:
        """The state and what is prescribed where the model computes; warns of particles outside of the bounds."""
        emulator = self.model.emulator
        state = self.state.to(emulator.device)
        warn_of_start_outside(emulator, state)
        return state, self.prescribed and self.prescribed.to(emulator.device)

    def timed_parts(
        self, stream: Iterable[Rollout], frames: int, times: list[float], what: str = "rollout",
        clock: Clock = time.perf_counter,
    ) -> Iterator[Rollout]:  # fmt: skip
        """The frames of a rollout that are written, so many in all, on the CPU, with a progress bar.

        Adds the time in seconds at the start, and after each bundle, to `times`.
        """
        times.append(clock())
        first = self.between - 1
        with progress_bar(what, -(-frames * self.between // self.model.emulator.frames)) as step:
            for part in stream:
                kept = slice(first, None, self.between)
                fields = {name: values[:, kept].cpu() for name, values in part.fields.items()}
                written = part._replace(position=part.position[:, kept].cpu(), fields=fields)
                first = (first - part.position.shape[1]) % self.between
                times.append(clock())
                yield written
                step()

    def predict(self, frames: int, monitor: Monitor, clock: Clock = time.perf_counter) -> tuple[Rollout, float]:
        """So many frames, and the milliseconds per frame."""
        state, given = self.on_device()
        options, times = RolloutOptions(given, monitor=monitor), list[float]()
        stream = stream_rollout(self.model.emulator, state, frames * self.between, options)
        parts = list(self.timed_parts(stream, frames, times, clock=clock))
        return Rollout.join(parts), milliseconds(times, self.model.emulator.frames / self.between)

    def trajectory(self, name: str, rollout: Rollout, start: Particles | None = None) -> Trajectory:
        """The start and a prediction of it by the model of a name, beside what was recorded."""
        recorded = self.recorded
        origin = f"the zoo model {name}" if "sha256" in self.model.card else f"the model {name}"
        made = predicted_trajectory(
            self.scene,
            (start or self.written).to("cpu"),
            rollout.position,
            origin,
            fields=rollout.fields,
            truth=None if recorded is None else recorded.recorded[:, : rollout.position.shape[1] + 2],
            real=None if recorded is None else recorded.mask,
            obstacle_frames=None if recorded is None else recorded.obstacle_frames,
        )
        return self.as_recorded(made)

    def errors(self, recorded: Window, rollouts: Iterable[Rollout]) -> dict[str, float]:
        """Mean errors of rollouts and of the trivial predictors, over the frames that were also recorded."""
        from nmpm.evaluation.comparison import Comparison  # imports torchmetrics, and matplotlib with it
        from nmpm.metrics import MSE

        comparison = Comparison(self.scene, [MSE()], max(1, self.model.emulator.frames // self.between))
        for rollout in rollouts:
            frames = min(recorded.target.shape[1], rollout.position.shape[1])
            fields = {name: values[:, :frames] for name, values in rollout.fields.items()}
            comparison.update(recorded.first(frames + 2), rollout.position[:, :frames], fields)
        return {name: float(value) for name, value in comparison.compute().items()}


def recorded_start(
    model: Pretrained,
    data: str | Path,
    split: str | None = None,
    trajectory: int = 0,
    facts: Options | None = None,
    materials: Mapping[str, str] | None = None,
    stride: Fraction | None = None,
    strict: bool = False,
) -> Start:
    """What a rollout of a recorded trajectory starts from, as `nmpm rollout --data` does.

        start = recorded_start(Zoo.load("waterramps"), "drop.npz")
        rollout, milliseconds = start.predict(400, Monitor())
        print(start.errors(start.recorded, [rollout]))
        nmpm.write_trajectories("out.h5", [start.trajectory("waterramps", rollout)])

    Data of another kind than the model's are matched to it, see `Pretrained.fit_to`; `model.match` of the start, else
    None, says how.

    Args:
        model: The model.
        data: A file or folder of any form that is read, or the name of an embedded dataset.
        split: Of several; the test split, or the only one, if left out.
        trajectory: Its index in the split.
        facts: That the files lack or state wrongly.
        materials: As for `Pretrained.fit_to`.
        stride: As for `Pretrained.fit_to`; data of the model's own kind are matched, too, where it is given.
        strict: As for `Pretrained.fit_to`.

    Raises:
        ConfigError: if there is no such trajectory, or the model cannot be matched to the data.
        DataError: if the files cannot be read.
    """
    index, facts = trajectory, facts or Options()
    path = find_data(Path(data), split, index)
    recorded = Split(native_file(path, split, facts))
    if index >= len(recorded):
        raise ConfigError(f"trajectory {index}: {path} contains trajectories 0 … {len(recorded) - 1}.")
    if recorded.frames(index) < 2:
        raise ConfigError(f"trajectory {index}: it has one frame in {path}; a rollout starts from two.")
    facts = with_family(facts, recorded)
    metadata = file_metadata(recorded, facts)
    if facts.gravity is not None:
        check_gravity(facts.gravity, trajectory_gravity(recorded.attributes(index), metadata, ""), path)
    if recorded.path in (path, path / recorded.path.name):  # a converted copy has the facts
        metadata = facts.apply_to(metadata)
    if stride is None and is_of_kind(model.scene, metadata, recorded, index):
        warn_of_ignored(model.scene, metadata.fields)
        reading, scene, between = Reading(model.scene), model.scene, 1
        recordings = SplitRecordings(recorded, metadata, reading)
        window = written = collate([recordings[index]], reading)
    else:
        beside = path == recorded.path and (path.parent / METADATA_FILE).is_file()
        dataset = Dataset(FolderSource(path.parent if beside else path, facts))
        match = match_data(model.emulator, model.name, dataset, materials, stride, strict)
        model, between = model.matched(match), match.reading.between
        scene = dataclasses.replace(dataset.scene, dt=dataset.scene.dt * match.reading.every)
        window = collate([SplitRecordings(recorded, metadata, match.reading)[index]], match.reading)
        reading = Reading(scene, every=match.reading.every)
        recordings = SplitRecordings(recorded, metadata, reading)
        written = collate([recordings[index]], reading)
    return Start(
        model,
        scene,
        window.initial,
        written.initial,
        written if written.target.shape[1] else None,
        Prescribed.of(window),
        between,
        lambda made: recordings.as_recorded(made, index),
        f"{path}, trajectory {index}",
    )


class MemberFrames(ExitStack):
    """Frames of members in temporary files of a folder, so that memory holds those of one member."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._files: dict[str, tuple[IO[bytes], np.dtype, tuple[int, ...]]] = {}

    def add(self, part: Rollout) -> None:
        """Append frames (M, t, …) of positions and fields; raises OSError, naming the folder, on a full disk."""
        for name, values in {"": part.position, **part.fields}.items():
            frames = values.transpose(0, 1).numpy()
            if name not in self._files:
                file = self.enter_context(TemporaryFile(dir=self._folder))  # noqa: SIM115 (it is one)
                self._files[name] = file, frames.dtype, frames.shape[1:]
            try:
                self._files[name][0].write(frames.tobytes())
                self._files[name][0].flush()
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(self._folder)) from error

    def member(self, index: int) -> Rollout:
        """The frames of a member, (1, T, N, D) and (1, T, N)."""
        arrays = {
            name: torch.from_numpy(np.array(np.memmap(file, kind, mode="r").reshape(-1, *shape)[None, :, index]))
            for name, (file, kind, shape) in self._files.items()
        }
        return Rollout(arrays.pop(""), arrays)


def milliseconds(times: Sequence[float], frames: float) -> float:
    """Median milliseconds per frame, from times in seconds at the start and after each bundle of so many frames.

    Without the first bundle where there are several, as that may compile programs.
    """
    each = np.diff(times)
    return float(1000 * np.median(each[1:] if len(each) > 1 else each) / frames)


def is_of_kind(scene: Scene, metadata: Metadata, split: Split, index: int) -> bool:
    """Whether a trajectory can be read as one of a model's scene, as nothing that its file states is another.

    That is materials, obstacles, box, volume of particles, time between frames and gravity; bounds agree to a 64th of
    the box, gravity, which may be measured, to 5%. What could only be guessed, of a file that states nothing, decides
    nothing where the box may be the model's.
    """
    types = set(np.unique(split.particle_type(index)).tolist())
    names = {metadata.particle_types[i] for i in metadata.moving_types if i in types}
    if metadata.dim != scene.dim or not names <= set(scene.materials) or metadata.boundary != scene.boundary:
        return False
    obstacles, moving = types & metadata.obstacle_types, types & metadata.prescribed_types
    if (obstacles and not scene.obstacles) or (moving and not scene.moving_obstacles):
        return False
    guessed = {name for name, how in metadata.extra.get(FOUND, {}).items() if str(how).startswith("guessed")}
    ours, theirs = np.array(scene.bounds if "bounds" not in guessed else scene.domain), np.array(metadata.bounds)
    cell = float((ours[:, 1] - ours[:, 0]).max()) / 64
    within = (theirs[:, 0] > ours[:, 0] - cell).all() and (theirs[:, 1] < ours[:, 1] + cell).all()
    if not within or ("bounds" not in guessed and not np.allclose(theirs, ours, 0, cell)):
        return False
    attributes, volume = split.attributes(index), metadata.particle_volume
    if volume and VOLUME not in {*attributes, *guessed} and not is_same_volume(scene.particle_volume, volume):
        return False
    if scene.gravity_varies and "gravity" not in attributes:
        return False  # the model is told that of each trajectory
    gravity = trajectory_gravity(attributes, metadata, split.where(index))
    if not np.isclose(metadata.dt, scene.dt, rtol=1e-3):
        return gravity is None and "dt" in guessed
    return scene.gravity_varies or gravity is None or scene.gravity is None or is_gravity_of(scene, gravity)
