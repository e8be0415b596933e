"""`nmpm simulate NAME --train 1000 --valid 30 --test 30 --seed 0 --workers 8 --out DIR`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.shipped import find_preset
from nmpm.cli.options import CommandParser, check_at_least, check_folder, check_picture

if TYPE_CHECKING:
    from nmpm.sim import Preset


_EXAMPLES = """\
examples:
  nmpm simulate --list                               the shipped scenes
  nmpm simulate waterramps --preview ramps.png       draw one trajectory, write no data
  nmpm simulate waterramps --preview ramps.vtkhdf    write it for ParaView; .usda for Blender, …
  nmpm simulate waterramps --train 100 --valid 10 --test 10 --out ramps
  nmpm simulate waterramps --shard 2/8 --out ramps   one of 8 jobs; the last completes the folder
  nmpm simulate my-scene.yaml --out mine             your own scene, from a copy of a shipped one
  nmpm simulate goop --show > my-scene.yaml          such a copy, with comments

The same preset, seed and numbers give the same data. After an interruption the same call resumes. The metadata state
that the data are simulated by nmpm.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["simulate", "waterramps", "--out", "ramps"].

    Raises:
        SystemExit: with status 130 after Ctrl-C.
    """
    from nmpm.data.write import SUFFIXES

    parser = CommandParser(
        prog="nmpm simulate",
        description="Simulate a dataset of a shipped scene or your own, ready for training.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("name", nargs="?", help="a shipped scene, or a YAML file")
    parser.add_argument("--list", action="store_true", help="list the shipped scenes")
    parser.add_argument("--show", action="store_true", help="print the scene's YAML")
    parser.add_argument(
        "--preview", type=Path, metavar="FILE", help=f"simulate one trajectory: a .png draws it, {SUFFIXES} hold it"
    )
    for split in ("train", "valid", "test"):
        parser.add_argument(f"--{split}", type=int, metavar="N", help=f"{split} trajectories (default: the paper's)")
    parser.add_argument("--frames", type=int, help="frames after the initial one (default: the scene's)")
    parser.add_argument("--seed", type=int, default=0, help="of the whole dataset (default: 0)")
    parser.add_argument("--workers", type=int, help="processes (default: one per processor core)")
    parser.add_argument(
        "--shard", metavar="I/N", help="simulate the I-th of N parts, from 1 on; N processes share the folder --out"
    )
    parser.add_argument("--out", type=Path, help="folder to write (default: the scene's name)")
    options = parser.parse_args(words[1:])
    if options.list:
        _list()
        return
    if options.name is None:
        parser.error("name a scene, or use --list")
    find_preset(options.name)
    if options.show:
        from nmpm.sim.loading import preset_text

        sys.stdout.write(preset_text(options.name))
        return
    try:
        _simulate(options)
    except KeyboardInterrupt:
        kept = "nothing was written" if options.preview else "the same command continues after finished trajectories"
        raise KeyboardInterrupt(f"interrupted; {kept}.") from None


def _simulate(options: argparse.Namespace) -> None:
    for name, least in (("workers", 1), ("frames", 1), ("seed", 0), ("train", 0), ("valid", 0), ("test", 0)):
        check_at_least(f"--{name}", getattr(options, name), least)
    if options.preview is not None:
        _check_preview(options.preview)
    elif options.out is not None:
        check_folder("--out", options.out)
    from nmpm.data import catalog
    from nmpm.data.generate import generate, generate_shard
    from nmpm.data.simulation import Shard
    from nmpm.sim import load_preset

    shard = None if options.shard is None else Shard.parse(options.shard)
    preset = load_preset(options.name)
    preset = preset if options.frames is None else preset.with_frames(options.frames)
    if options.preview is not None:
        _preview(preset, options.seed, options.preview)
        return
    counts = dict(catalog.describe(options.name if options.name in catalog.catalog() else "goop").paper)
    counts |= {name: getattr(options, name) for name in counts if getattr(options, name) is not None}
    out = options.out or Path(preset.name)
    check_folder("--out", out)
    if shard is None:
        generate(preset, out, counts, options.seed, options.workers)
    elif missing := generate_shard(preset, out, counts, shard, options.seed, options.workers):
        sys.stdout.write(f"shard {shard} is in {out}; trajectories of other shards that are not there yet: {missing}\n")
        return
    sys.stdout.write(f"wrote {', '.join(f'{n} {s}' for s, n in counts.items() if n)} trajectories to {out}\n")
    sys.stdout.write(f"to look at them: nmpm inspect {shlex.quote(str(out))}\n")


def _check_preview(path: Path) -> None:
    """Raise ConfigError, before the work, if a preview cannot be written."""
    from nmpm.data.write import find_writer, is_written_by_suffix

    if is_written_by_suffix(path):
        find_writer("--preview", path)
    else:
        check_picture("--preview", path)


def _list() -> None:
    from nmpm.data import catalog
    from nmpm.sim import load_preset

    sys.stdout.write(f"{'scene':<17}{'method':<9}{'axes':<6}{'particles':<11}{'frames':<8}{'splits':<15}materials\n")
    for name in catalog.catalog():
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
    from nmpm.data.generate import preset_metadata
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
