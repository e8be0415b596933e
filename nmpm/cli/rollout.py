"""`nmpm rollout MODEL --frames 400 --out out.h5`."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from nmpm.cli.command import option
from nmpm.cli.options import (
    Data,
    DeviceOptions,
    FactOptions,
    MatchOptions,
    ModelOptions,
    Natural,
    Positive,
    RuntimeOptions,
    SplitName,
    StrictReadingOptions,
    ThreadsOptions,
    TrajectoryFile,
    choose_threads,
)
from nmpm.errors import ConfigError


def _check_nudge(option: str, cells: float) -> None:
    if not 0 <= cells < math.inf:
        raise ConfigError(f"{option} {cells}: it must be a number of cells, 0 or more, such as 0.1.")


@dataclass(frozen=True, kw_only=True)
class RollOut(ModelOptions, DeviceOptions, ThreadsOptions, RuntimeOptions, StrictReadingOptions, FactOptions):
    """Roll a pretrained model out and write the trajectories.

    It starts in a scene as those of the model's training, from thrown blocks of particles, or from a recorded
    trajectory.

    Args:
        frames: Frames to predict (default: 400; with --data, the recording's).
        out: File to write, by its suffix: {suffixes}.
        data: Start from a trajectory of this file or folder, of any format that nmpm inspect reads, or of an embedded
            dataset (goop, …); write it beside the prediction, and print the error.
        split: Of --data, if it has several (default: test).
        trajectory: Index in --data (default: 0, the first).
        seed: Of the scene, and of members (default: 0).
        members: Rollouts from the same start, by a model's own noise or from nudged positions; a trajectory each, in
            one .h5 or .vtkhdf, or in out-0.csv, out-1.csv, ….
        nudge: Standard deviation of the displacements of members' starts (default: the model's, see nmpm zoo card).
        until: End with the last frame that is trusted, see the how-to.
        particles: Throw blocks of about so many in all (with --blocks: 1000).
        blocks: Throw so many blocks (with --particles: one of each material).
        precision: Of the network: float32 (default), or bfloat16, less accurate, faster if the processor supports it.
        watch: If speed, energy or crowding exceed the model's known range: warn (default), stop, or only record.

    Examples:
        nmpm rollout waterramps --frames 400 --out out.h5      a zoo model, in a scene of its simulator
        nmpm rollout waterramps --blocks 3 --seed 1            from thrown blocks
        nmpm rollout waterramps --data waterramps              from a test scene, beside the simulation
        nmpm rollout runs/goop --data test.h5 --trajectory 3   a run's best, from a recorded start
        nmpm rollout runs/grains --data grains.npz             or from any other form of data
        nmpm rollout sandramps --data grains --materials big=sand,small=sand
                                                               or from data of another kind
        nmpm rollout runs/mixer --data mixer.npz --types 0=dough,1=blade --prescribed 1
                                                               with facts that the files lack
        nmpm rollout wbcsph --gravity 6,7.5                    thrown blocks, with gravity to one side
        nmpm rollout runs/goop/checkpoints/last.ckpt
        nmpm rollout goop --out splash.usda                    for Blender; .vtkhdf for ParaView, .csv, …
        nmpm rollout goop --device cuda                        on a GPU, by CUDA graphs
        nmpm rollout waterramps --until trusted                as far as it predicts this scene
        nmpm rollout waterramps --members 8                    eight futures of one start
    """

    frames: Positive | None = None
    out: TrajectoryFile = Path("out.h5")
    data: Data | None = None
    split: SplitName | None = None
    trajectory: Natural = 0
    seed: Natural = 0
    members: Positive | None = option(metavar="M")
    nudge: Annotated[float, _check_nudge] | None = option(metavar="CELLS")
    until: Literal["trusted"] | None = None
    particles: Positive | None = None
    blocks: Positive | None = None
    precision: Literal["float32", "bfloat16"] = "float32"
    watch: Literal["warn", "stop", "record"] = "warn"

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        from nmpm.data.write import suffixes

        return {**super().help_values(), "suffixes": suffixes()}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.data is None and self.match != MatchOptions():
            raise ConfigError("--materials, --stride and --strict are about recorded data: give --data too.")
        facts = [fact for fact in self.arguments if not fact.startswith("--gravity")]
        if self.data is None and facts:
            raise ConfigError(f"{facts[0]} is about recorded data: give --data too.")
        if self.members is not None and self.until:
            raise ConfigError("--until is about one rollout: leave --members out.")
        if self.nudge is not None and self.members is None:
            raise ConfigError(f"--nudge {self.nudge} displaces the starts of members: give --members too.")
        from nmpm.data.write import find_writer

        for path in find_writer("--out", self.out).paths(self.out, self.members or 0):
            find_writer("--out", path)

    def run(self) -> None:
        from nmpm.cli.prediction import roll_out, start_of
        from nmpm.zoo.registry import load_model

        model = load_model(self.model, self.device, self.root)
        start = start_of(model, self)
        model = start.model.optimized(self.runtime, self.precision, start.state)
        choose_threads(model, self.threads)
        sys.stdout.write(f"to look at them: {roll_out(dataclasses.replace(start, model=model), self)}\n")
