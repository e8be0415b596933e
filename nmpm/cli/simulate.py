"""`nmpm simulate NAME --train 1000 --valid 30 --test 30 --seed 0 --workers 8 --out DIR`."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.shipped import find_preset
from nmpm.cli.command import Command, UsageError, option, positional
from nmpm.cli.options import Natural, OutputFolder, Positive, check_folder, check_picture

if TYPE_CHECKING:
    from nmpm.sim import Preset


@dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Simulate a dataset of one of the shipped scenes, or of one's own.

    Args:
        name: A scene of --list, or a YAML file.
        list: List the scenes, shipped and of installed packages.
        show: Print the scene's YAML.
        preview: Simulate one trajectory: a .png draws it, {suffixes} hold it.
        train: Training trajectories (default: the paper's).
        valid: Validation trajectories (default: the paper's).
        test: Test trajectories (default: the paper's).
        frames: Frames after the initial one (default: the scene's).
        seed: Of the whole dataset (default: 0).
        workers: Processes (default: one per processor core).
        shard: Simulate the I-th of N parts, from 1 on; N processes share the folder --out.
        out: Folder to write (default: the scene's name).

    Examples:
        nmpm simulate --list                               the scenes
        nmpm simulate waterramps --preview ramps.png       draw one trajectory, write no data
        nmpm simulate waterramps --preview ramps.vtkhdf    write it for ParaView; .usda for Blender, …
        nmpm simulate waterramps --train 100 --valid 10 --test 10 --out ramps
        nmpm simulate waterramps --shard 2/8 --out ramps   one of 8 jobs; the last completes the folder
        nmpm simulate my-scene.yaml --out mine             your own scene, from a copy of a shipped one
        nmpm simulate goop --show > my-scene.yaml          such a copy, with comments

        The same preset, seed and numbers give the same data. After an interruption the same call resumes. The metadata
        state that the data are simulated by nmpm.
    """

    name: str | None = positional()
    list: bool = False
    show: bool = False
    preview: Path | None = option(metavar="FILE")
    train: Natural | None = option(metavar="N")
    valid: Natural | None = option(metavar="N")
    test: Natural | None = option(metavar="N")
    frames: Positive | None = None
    seed: Natural = 0
    workers: Positive | None = None
    shard: str | None = option(metavar="I/N")
    out: OutputFolder | None = None

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        from nmpm.data.write import suffixes

        return {"suffixes": suffixes()}

    def run(self) -> None:
        if self.list:
            _list()
            return
        if self.name is None:
            raise UsageError("name a scene, or use --list. See nmpm simulate --help.")
        find_preset(self.name)
        if self.show:
            from nmpm.sim.loading import preset_text

            sys.stdout.write(preset_text(self.name))
            return
        try:
            self._simulate(self.name)
        except KeyboardInterrupt:
            kept = "nothing was written" if self.preview else "the same command continues after finished trajectories"
            raise KeyboardInterrupt(f"interrupted; {kept}.") from None

    def _simulate(self, name: str) -> None:
        if self.preview is not None:
            from nmpm.data.write import find_writer, is_written_by_suffix

            if is_written_by_suffix(self.preview):
                find_writer("--preview", self.preview)
            else:
                check_picture("--preview", self.preview)
        from nmpm.data import catalog
        from nmpm.data.simulation import Shard, generate
        from nmpm.sim import load_preset, preset_names

        shard = None if self.shard is None else Shard.parse(self.shard)
        preset = load_preset(name)
        preset = preset if self.frames is None else preset.with_frames(self.frames)
        if self.preview is not None:
            _preview(preset, self.seed, self.preview)
            return
        counts = dict(catalog.describe(name if name in preset_names() else "goop").paper)
        counts |= {split: getattr(self, split) for split in counts if getattr(self, split) is not None}
        out = self.out or Path(preset.name)
        check_folder("--out", out)
        if missing := generate(preset, out, counts, self.seed, self.workers, shard=shard):
            left = f"trajectories of other shards that are not there yet: {missing}"
            sys.stdout.write(f"shard {shard} is in {out}; {left}\n")
            return
        sys.stdout.write(f"wrote {', '.join(f'{n} {s}' for s, n in counts.items() if n)} trajectories to {out}\n")
        sys.stdout.write(f"to look at them: nmpm inspect {shlex.quote(str(out))}\n")


def _list() -> None:
    from nmpm.data import catalog
    from nmpm.sim import load_preset, preset_names

    sys.stdout.write(f"{'scene':<17}{'method':<9}{'axes':<6}{'particles':<11}{'frames':<8}{'splits':<15}materials\n")
    for name in preset_names():
        preset, paper = load_preset(name), catalog.describe(name).paper
        scene, splits = preset.scene, "/".join(map(str, paper.values()))
        facts = {"obstacles": scene.obstacles, "gravity varies": scene.gravity_varies}
        varying = ", ".join(name for name, holds in facts.items() if holds)
        materials = ", ".join(scene.materials) + (f"; {varying}" if varying else "")
        sys.stdout.write(
            f"{name:<17}{preset.generator:<9}{scene.dim:<6}{f'≤ {preset.max_particles}':<11}"
            f"{preset.frames:<8}{splits:<15}{materials}\n"
        )


def _preview(preset: Preset, seed: int, path: Path) -> None:
    from nmpm._support.progress import progress_bar
    from nmpm.data.format import Trajectory
    from nmpm.data.simulation import preset_metadata
    from nmpm.data.write import is_written_by_suffix, write_trajectory
    from nmpm.viz import write_snapshots
    from nmpm.viz.files import label_trajectory

    with progress_bar(f"Simulating {preset.name}", preset.frames) as step:
        run = preset.simulate(seed, lambda _: step())
    trajectory, metadata = Trajectory(run.position, run.particle_type, run.attributes), preset_metadata(preset)
    if is_written_by_suffix(path):
        path = write_trajectory(path, trajectory, metadata)
    else:
        title = f"{preset.name}, simulated by nmpm ({preset.generator})"
        write_snapshots(label_trajectory(trajectory, "simulated", metadata, preset.scene, title), path)
    sys.stdout.write(f"wrote {path}\n")
