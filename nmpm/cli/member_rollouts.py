"""`nmpm rollout --members 8`: as many rollouts from one start, each of which becomes a trajectory."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Self

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from nmpm.cli.prediction import milliseconds, on_device, predicted, timed_parts
from nmpm.cli.recorded_start import RecordedStart, compared, recorded_errors
from nmpm.data.described import described_metadata
from nmpm.data.format import MEMBER, Trajectory
from nmpm.data.write import find_writer, write_trajectories
from nmpm.emulator import Prescribed, Rollout
from nmpm.emulator.members import member_starts
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.emulator.trust import TrustTracker, stream_watched
from nmpm.evaluation.figures import PREDICTORS, error_table
from nmpm.particles import Particles, Window
from nmpm.scene import Scene
from nmpm.zoo import Pretrained


@dataclass(frozen=True)
class MemberRollouts:
    """Members of one rollout, predicted, written and compared with a recording.

    Args:
        model: The model.
        scene: Of what is written.
        state: That the model starts from.
        written: The same in the materials and at the frames that are written.
        frames: How many to write.
        options: Of the command.
        between: Frames of the model per written frame.
        prescribed: What moves or enters as recorded.
        window: What was recorded, at the frames that are written; None of thrown blocks.
        recorded: The trajectory that the members start from; None of thrown blocks.
    """

    model: Pretrained
    scene: Scene
    state: Particles
    written: Particles
    frames: int
    options: argparse.Namespace
    between: int = 1
    prescribed: Prescribed | None = None
    window: Window | None = None
    recorded: RecordedStart | None = None

    def run(self, single: Rollout | None = None) -> str:
        """Predict and write; print the errors beside those of a `single` rollout; return how to look at the files."""
        with MemberFrames(self.options.out.parent, self.options.members) as frames:
            self._predict(frames)
            files = self._write(frames)
            if self.window is not None and single is not None:
                self._print_errors(self.window, frames, single)
        return find_writer("--out", self.options.out).hint(files[0])

    @property
    def _nudge(self) -> float:
        return self.model.nudge if self.options.nudge is None else float(self.options.nudge)

    def _predict(self, frames: MemberFrames) -> None:
        """Predict all frames of all members, and print what they cost."""
        emulator, members = self.model.emulator, self.options.members
        state, given = on_device(self.model, self.state, self.prescribed)
        monitor, steps = Monitor(Policy(self.options.watch)), self.frames * self.between
        tracker, times = TrustTracker(emulator.scene, state, self.model.trust), list[float]()
        stream = stream_watched(
            emulator, state, steps, tracker, members, self.options.seed, self._nudge, given, monitor
        )
        for part in timed_parts(self.model, f"{members} members", stream, steps, self.between, times):
            frames.add(part)
        cost = milliseconds(times, emulator.frames / self.between * members)
        sys.stdout.write(f"{members} members, {cost:.3g} ms per frame and member: {monitor.report()}\n")

    def _write(self, frames: MemberFrames) -> list[Path]:
        """Write a trajectory for each member; the files."""
        out, members = self.options.out, self.options.members
        emulator, seed = self.model.emulator, self.options.seed
        starts = member_starts(emulator, self.state.to(emulator.device), members, seed, self._nudge).to("cpu")

        def trajectory(member: int) -> Trajectory:
            start = self.written.with_motion(starts.position[[member]], self.written.velocity)
            rollout = frames.member(member)
            made = predicted(self.model, self.options.model, self.scene, start, rollout, self.window)
            made = made if self.recorded is None else self.recorded.as_recorded(made)
            return replace(made, attributes=made.attributes | {MEMBER: member})

        first = trajectory(0)
        metadata = described_metadata(first.attributes, out, len(first.position))
        files = write_trajectories(out, map(trajectory, range(members)), metadata, members * len(first.position))
        where = str(files[0]) if len(files) == 1 else f"{files[0]} … {files[-1]}"
        what = f"{members} members of 2 frames of the start and {self.frames} predicted"
        sys.stdout.write(f"wrote {what}, of {self.state.position.shape[1]} particles, to {where}\n")
        return files

    def _print_errors(self, window: Window, frames: MemberFrames, single: Rollout) -> None:
        """Print the mean error of single members beside that of one rollout without noise and nudge."""
        bundle = max(1, self.model.emulator.frames // self.between)
        figures = recorded_errors(self.scene, bundle, window, map(frames.member, range(frames.members)))
        one = recorded_errors(self.scene, bundle, window, [single])
        figures |= {f"single/{name}": value for name, value in one.items() if "/" not in name}
        names = {"model": f"a member, mean of {frames.members}", "single": "without noise and nudge"}
        Console().print(error_table(compared(window, single, self.options), figures, {**names, **PREDICTORS, **names}))


class MemberFrames:
    """Frames of M members in temporary files beside the output, so that memory holds those of one member.

    Args:
        folder: Of the output.
        members: M.
    """

    def __init__(self, folder: Path, members: int) -> None:
        self.members, self._folder, self._stack = members, folder, ExitStack()
        self._files: dict[str, tuple[IO[bytes], np.dtype, tuple[int, ...]]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, part: Rollout) -> None:
        """Append frames (M, t, …) of positions and fields; raises OSError, naming the folder, on a full disk."""
        for name, values in {"": part.position, **part.fields}.items():
            frames = values.transpose(0, 1).numpy()
            if name not in self._files:
                file = TemporaryFile(dir=self._folder)  # noqa: SIM115 (the stack closes it)
                self._files[name] = self._stack.enter_context(file), frames.dtype, frames.shape[1:]
            try:
                self._files[name][0].write(frames.tobytes())
                self._files[name][0].flush()
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(self._folder)) from error

    def member(self, index: int) -> Rollout:
        """The frames of a member, (1, T, N, D) and (1, T, N)."""
        arrays = {name: self._read(index, *stored) for name, stored in self._files.items()}
        return Rollout(arrays.pop(""), arrays)

    def _read(self, index: int, file: IO[bytes], kind: np.dtype, shape: tuple[int, ...]) -> Tensor:
        frames = np.memmap(file, kind, mode="r").reshape(-1, *shape)
        return torch.from_numpy(np.array(frames[None, :, index]))
