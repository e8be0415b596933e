"""Rollouts of commands: from a scene or a recording, predicted with a progress bar, timed, written and compared."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
import torch
from rich.console import Console

from nmpm._support.machine import device_name
from nmpm._support.progress import progress_bar
from nmpm.cli.options import describe, find_data
from nmpm.cli.rollout import RollOut
from nmpm.data.convert import native_file
from nmpm.data.convert.native import file_metadata, with_family
from nmpm.data.dataset import Dataset
from nmpm.data.format import MEMBER, METADATA_FILE, TRUTH, Metadata, Split, Trajectory
from nmpm.data.gravity import check_gravity, trajectory_gravity
from nmpm.data.metadata import FOUND
from nmpm.data.predictions import predicted_trajectory, read_description
from nmpm.data.recordings import SplitRecordings
from nmpm.data.sources import FolderSource
from nmpm.data.volumes import VOLUME
from nmpm.data.windows import collate
from nmpm.data.write import find_writer, write_trajectories, write_trajectory
from nmpm.emulator import Prescribed, Rollout, stream_rollout
from nmpm.emulator.fields import warn_of_ignored
from nmpm.emulator.members import member_starts
from nmpm.emulator.monitor import Monitor, Policy, warn_of_start_outside
from nmpm.emulator.trust import TrustTracker, stream_watched, until_trusted
from nmpm.errors import ConfigError
from nmpm.evaluation.figures import PREDICTORS, error_table
from nmpm.evaluation.machine import Clock
from nmpm.particles import Particles, Window
from nmpm.scene import Reading, Scene, is_same_volume
from nmpm.sim import load_preset
from nmpm.zoo import Pretrained
from nmpm.zoo.fallback import fitting_preset, simulate_rest
from nmpm.zoo.matching import match_data
from nmpm.zoo.scenes import training_preset
from nmpm.zoo.states import THROWN, is_gravity_of

FRAMES = 400
"""Predicted without a recording, unless an option says otherwise."""


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
        stream, times = stream_rollout(self.model.emulator, state, frames * self.between, monitor, given), list[float]()
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

    def print_errors(
        self, recorded: Window, shown: Rollout, figures: Mapping[str, float], names: Mapping[str, str] = PREDICTORS
    ) -> None:
        """Print a table of errors over the frames of a rollout that were recorded."""
        frames = min(recorded.target.shape[1], shown.position.shape[1])
        Console().print(error_table(f"{self.source}, {frames} frames:", figures, names))


def scene_start(model: Pretrained, options: RollOut) -> Start:
    """A scene of the model's training, or thrown blocks; what it is is printed."""
    gravity, preset = options.facts.gravity, training_preset(model)
    if options.particles is None and options.blocks is None and preset is not None:
        state = model.example(options.seed, gravity=gravity)
        solid = ", with obstacles" if state.obstacle.shape[1] else ""
        count = state.position.shape[1]
        sys.stdout.write(f"Scene of {preset.name}, seed {options.seed}: {count:,} particles{solid}.\n")
        return Start(model, model.scene, state, state)
    if options.particles is None and options.blocks is None:
        sys.stdout.write(
            f"No preset has the scenes that {options.model} was trained on: about {THROWN:,} particles are thrown into"
            " its box. --data starts from a recorded scene.\n"
        )
    count = THROWN if options.particles is None else options.particles
    try:
        state = model.example(options.seed, count, options.blocks, gravity)
    except ConfigError as error:
        blocks = "" if options.blocks is None else f" --blocks {options.blocks}"
        raise ConfigError(f"--particles {count}{blocks}: {error}") from error
    return Start(model, model.scene, state, state)


def recorded_start(model: Pretrained, options: RollOut, data: Path) -> Start:
    """The trajectory of --data, --split and --trajectory, with the facts that other options state.

    How the model takes data of another kind is printed.

    Raises:
        ConfigError: if there is no such trajectory, or the model cannot be matched to the data.
    """
    path, index, facts = (
        find_data(data, options.split, options.trajectory),
        options.trajectory,
        options.facts,
    )
    split = Split(native_file(path, options.split, facts))
    if index >= len(split):
        raise ConfigError(f"--trajectory {index}: {path} contains trajectories 0 … {len(split) - 1}.")
    if split.frames(index) < 2:
        raise ConfigError(f"--trajectory {index}: it has one frame in {path}; a rollout starts from two.")
    facts = with_family(facts, split)
    metadata = file_metadata(split, facts)
    if facts.gravity is not None:
        check_gravity(facts.gravity, trajectory_gravity(split.attributes(index), metadata, ""), path)
    if split.path in (path, path / split.path.name):  # a converted copy has the facts
        metadata = facts.apply_to(metadata)
    stated = options.match
    if stated.stride is None and is_of_kind(model.scene, metadata, split, index):
        warn_of_ignored(model.scene, metadata.fields)
        reading, scene, between = Reading(model.scene), model.scene, 1
        recordings = SplitRecordings(split, metadata, reading)
        window = written = collate([recordings[index]], reading)
    else:
        beside = path == split.path and (path.parent / METADATA_FILE).is_file()
        dataset = Dataset(FolderSource(path.parent if beside else path, facts))
        match = match_data(model, dataset, *stated)
        sys.stdout.write(describe(match, model.name))
        model, between = model.matched(match), match.reading.between
        scene = dataclasses.replace(dataset.scene, dt=dataset.scene.dt * match.reading.every)
        window = collate([SplitRecordings(split, metadata, match.reading)[index]], match.reading)
        reading = Reading(scene, every=match.reading.every)
        recordings = SplitRecordings(split, metadata, reading)
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


def roll_out(start: Start, options: RollOut) -> str:
    """Predict, write and compare with what was recorded, as the options say; how to look at the files."""
    frames = options.frames or (FRAMES if start.recorded is None else start.recorded.target.shape[1])
    if options.members is not None:
        files = _roll_out_members(start, frames, options.members, options)
    else:
        rollout = (_predict_trusted if options.until or options.fallback else _predict)(start, frames, options)
        files = _write(iter([start.trajectory(options.model, rollout)]), options)
        if start.recorded is not None:
            start.print_errors(start.recorded, rollout, start.errors(start.recorded, [rollout]))
    return find_writer("--out", options.out).hint(files[0])


def _predict(start: Start, frames: int, options: RollOut) -> Rollout:
    """So many frames; what was watched and the time of a frame are printed."""
    monitor = Monitor(Policy(options.watch))
    rollout, taken = start.predict(frames, monitor)
    device = device_name(start.model.emulator.device)
    sys.stdout.write(f"{monitor.report()}\n{taken:.3g} ms per frame on {device}.\n")
    return rollout


def _predict_trusted(start: Start, frames: int, options: RollOut) -> Rollout:
    """The frames that are trusted, of so many at most; with a fallback all, those that follow simulated.

    Raises:
        ConfigError: if the fallback does not fit, or no frame is trusted and there is none.
    """
    preset, model = None, start.model
    if options.fallback is not None:
        if start.prescribed is not None or start.between > 1:
            raise ConfigError(
                f"--fallback {options.fallback}: a simulator goes on from what moves freely, in the model's own frames;"
                f" {'--stride asks for others' if start.prescribed is None else 'these data prescribe motion'}."
            )
        preset = fitting_preset(model.scene, start.state, load_preset(options.fallback))
    state, given = start.on_device()
    tracker, monitor, steps = (
        TrustTracker(model.scene, state, model.trust),
        Monitor(Policy(options.watch)),
        frames * start.between,
    )
    watched = stream_watched(model.emulator, state, steps, tracker, prescribed=given, monitor=monitor)
    trusted = Rollout.join(list(start.timed_parts(until_trusted(watched, tracker), frames, [])))
    sys.stdout.write(f"{monitor.report()}\n")
    made = trusted.position.shape[1]
    if preset is None and not made:
        raise ConfigError(f"--until trusted: no frame is. {tracker.report()} Without it, all are written.")
    if preset is None or made == frames:
        return trusted
    with progress_bar(f"Simulating {preset.name}", frames - made) as step:
        trusted = trusted._replace(trusted=tracker.frames)
        whole = simulate_rest(model.scene, start.state.to("cpu"), trusted, preset, frames, lambda _: step())
    sys.stdout.write(f"frames {made + 1} to {frames} are simulated by {preset.name} ({preset.generator})\n")
    return whole


def _roll_out_members(start: Start, frames: int, members: int, options: RollOut) -> list[Path]:
    """Predict and write members; print their mean error beside that of one rollout without noise and nudge."""
    single = None if start.recorded is None else _predict(start, frames, options)
    model, seed = start.model, options.seed
    emulator, nudge = model.emulator, model.nudge if options.nudge is None else options.nudge
    with MemberFrames(options.out.parent) as stored:
        state, given = start.on_device()
        tracker, monitor = TrustTracker(emulator.scene, state, model.trust), Monitor(Policy(options.watch))
        stream = stream_watched(emulator, state, frames * start.between, tracker, members, seed, nudge, given, monitor)
        times: list[float] = []
        for part in start.timed_parts(stream, frames, times, f"{members} members"):
            stored.add(part)
        cost = milliseconds(times, emulator.frames / start.between * members)
        sys.stdout.write(f"{members} members, {cost:.3g} ms per frame and member: {monitor.report()}\n")
        starts = member_starts(emulator, state, members, seed, nudge).to("cpu")

        def trajectory(member: int) -> Trajectory:
            moved = start.written.with_motion(starts.position[[member]], start.written.velocity)
            made = start.trajectory(options.model, stored.member(member), moved)
            return dataclasses.replace(made, attributes=made.attributes | {MEMBER: member})

        files = _write(map(trajectory, range(members)), options)
        if start.recorded is not None and single is not None:
            figures = start.errors(start.recorded, map(stored.member, range(members)))
            one = start.errors(start.recorded, [single])
            figures |= {f"single/{name}": value for name, value in one.items() if "/" not in name}
            names = {"model": f"a member, mean of {members}", "single": "without noise and nudge"}
            start.print_errors(start.recorded, single, figures, {**names, **PREDICTORS, **names})
    return files


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


def _write(trajectories: Iterator[Trajectory], options: RollOut) -> list[Path]:
    """Write a prediction, or those of members, and print what the files hold."""
    first, out, members = next(trajectories), options.out, options.members
    _, metadata = read_description(first.attributes, out, len(first.position))
    particles = int(metadata.is_moving(first.particle_type).sum())
    what = f"2 frames of the start and {len(first.position) - 2} predicted, of {particles} particles"
    if members is None:
        files = [write_trajectory(out, first, metadata)]
        what += ", beside the recording" if TRUTH in first.fields else ""
    else:
        files = write_trajectories(out, chain([first], trajectories), metadata, members * len(first.position))
        what = f"{members} members of {what}"
    sys.stdout.write(f"wrote {what}, to {files[0]}{f' … {files[-1]}' if len(files) > 1 else ''}\n")
    return files


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
