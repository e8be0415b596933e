"""`nmpm rollout NAME --frames 400 --out out.h5`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.particles import Particles
    from nmpm.zoo.registry import Pretrained


def run(words: list[str]) -> None:
    """Run the command, e.g. ["rollout", "goop", "--frames", "400", "--out", "out.h5"]."""
    parser = argparse.ArgumentParser(
        prog="nmpm rollout",
        description="Roll a pretrained model out, from thrown blocks of particles or from a recorded trajectory.",
    )
    parser.add_argument("name", help="a model of the zoo, see nmpm zoo list")
    parser.add_argument("--frames", type=int, default=400, help="frames to predict (default: 400)")
    parser.add_argument("--out", type=Path, default=Path("out.h5"), help="file to write (default: out.h5)")
    parser.add_argument("--data", type=Path, help="start from a trajectory of this HDF5 file (native layout)")
    parser.add_argument("--trajectory", type=int, default=0, help="which trajectory of --data (default: the first)")
    parser.add_argument("--seed", type=int, default=0, help="of the thrown blocks (default: 0)")
    parser.add_argument("--particles", type=int, default=1000, help="about how many to throw (default: 1000)")
    parser.add_argument("--blocks", type=int, default=1, help="into how many blocks (default: 1)")
    parser.add_argument(
        "--precision",
        choices=["float32", "bfloat16"],
        default="float32",
        help="of the network: float32 (default), or bfloat16, faster where the processor has it, and rougher",
    )
    parser.add_argument(
        "--watch",
        choices=["warn", "stop", "record"],
        default="warn",
        help="where speed, energy or crowding leave what the model is known for: warn (default), stop, or only record",
    )
    chosen = parser.parse_args(words[1:])
    if chosen.frames < 1:
        raise ConfigError(f"--frames {chosen.frames}: ask for at least 1 frame.")
    if not chosen.out.parent.is_dir():
        raise ConfigError(f"--out {chosen.out}: the folder {chosen.out.parent} does not exist.")
    from nmpm.zoo.registry import Zoo

    model = Zoo.load(chosen.name).with_network(chosen.precision)
    if chosen.data is None:
        try:
            state = model.example(chosen.seed, chosen.particles, chosen.blocks)
        except ValueError as error:
            raise ConfigError(f"{error} Use fewer --particles or more --blocks.") from error
    else:
        state = _recorded(model, chosen.data, chosen.trajectory)
    _write(model, state, chosen)
    sys.stdout.write(f"wrote {chosen.frames + 2} frames of {state.position.shape[1]} particles to {chosen.out}\n")


def _recorded(model: Pretrained, path: Path, index: int) -> Particles:
    """The state at the second frame of a recorded trajectory."""
    from nmpm.data.format import Split, read_metadata
    from nmpm.data.loading.padded_batch import collate
    from nmpm.data.loading.recording import SplitRecordings

    metadata = read_metadata(path.parent, _family(model))
    recordings = SplitRecordings(Split(path), metadata, model.scene)
    if not 0 <= index < len(recordings):
        raise ConfigError(f"--trajectory {index}: {path} holds trajectories 0 … {len(recordings) - 1}.")
    return collate([recordings[index]], model.scene, 2).initial


def _family(model: Pretrained) -> str | None:
    from nmpm.data.families import FAMILIES

    known = set(FAMILIES["deepmind"].types.values())
    return "deepmind" if set(model.scene.materials) <= known else None


def _write(model: Pretrained, state: Particles, chosen: argparse.Namespace) -> None:
    """The two frames of the start, then the prediction, with what is needed to draw it."""
    import torch
    from rich.progress import track

    from nmpm.data.format import write_split
    from nmpm.data.predictions import predicted_trajectory
    from nmpm.emulator.monitor import Monitor, Policy
    from nmpm.emulator.rollouts import stream

    bundles, monitor = -(-chosen.frames // model.emulator.frames), Monitor(Policy(chosen.watch))
    made = stream(model.emulator, state, chosen.frames, monitor)
    parts = list(track(made, "rollout", total=bundles, transient=True))
    origin = f"the zoo model {chosen.name}"
    write_split(chosen.out, [predicted_trajectory(model.scene, state, torch.cat(parts, dim=1), origin)])
    sys.stdout.write(monitor.report() + "\n")
