"""What a call costs with each network, transfer and decoder together, on one scene in 2-D and in 3-D.

python benchmarks/parts.py --threads 1 --json parts.json

Networks are those of sweeps/parts.yaml, untrained and under autocast to bfloat16. The table shows the networks against
the transfers, and what the decoders add to the first of them; the JSON file has every combination.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import torch
from ablation import Sweep, module_of
from forms import PRESETS, scenes
from turns import arguments, in_one_process, machine, write

from nmpm.emulator.model import Emulator
from nmpm.particles import Particles
from nmpm.scene import Scene

SWEEP = Path(__file__).parent / "sweeps" / "parts.yaml"
GRIDS = {2: 64, 3: 32}
TRANSFERS = ("Linear", "Nearest", "Quadratic", "Affine")
DECODERS = ("Residual", "Absolute", "Flip", "Blend", "Acceleration")
Key = tuple[str, str, str]


def combinations(scene: Scene) -> dict[Key, Emulator]:
    """An emulator for each network, transfer and decoder."""
    sweep = Sweep.read(SWEEP)
    networks = [name for name, own in sweep.variants.items() if not own or "processor" in own.get("model", {})]
    return {key: _emulator(sweep.whole(key[0]), scene, *key[1:]) for key in product(networks, TRANSFERS, DECODERS)}


def _emulator(config: dict[str, Any], scene: Scene, transfer: str, decoder: str) -> Emulator:
    parts = {
        "transfer": {"class_path": f"nmpm.transfer.{transfer}"},
        "decoder": {"class_path": f"nmpm.decoders.{decoder}"},
    }
    model = config["model"] | parts | {"cells": GRIDS[scene.dim], "constraints": {}}
    return module_of(config | {"model": model}, scene).emulator.eval().requires_grad_(False)


@torch.inference_mode()
def milliseconds(emulators: Mapping[Key, Emulator], state: Particles, rounds: int) -> dict[Key, float]:
    """Of a call, median over the rounds, in each of which every emulator has its turn."""
    calls = {key: partial(emulator, state, emulator.context(state)) for key, emulator in emulators.items()}
    with torch.autocast(state.position.device.type, torch.bfloat16):
        spent = in_one_process(calls, rounds)
    return {key: 1e3 * statistics.median(seconds) for key, seconds in spent.items()}


def table(found: Mapping[Key, float]) -> str:
    """A line per network, then one for the decoders."""
    networks = list(dict.fromkeys(key[0] for key in found))
    lines = [f"{'':28}" + "".join(f"{name:>14}" for name in TRANSFERS)]
    for network in networks:
        cells = (found[network, transfer, DECODERS[0]] for transfer in TRANSFERS)
        lines.append(f"{network:28}" + "".join(f"{value:>14.4g}" for value in cells))
    for decoder in DECODERS[1:]:
        over = [found[n, t, decoder] - found[n, t, DECODERS[0]] for n in networks for t in TRANSFERS]
        lines.append(f"{decoder} instead of {DECODERS[0]}: {statistics.median(over):+.2g}")
    return "\n".join(lines)


def main() -> None:
    """Measure, print the tables, and write JSON if asked to."""
    parser = arguments(__doc__)
    parser.add_argument("--particles", type=int, default=2300)
    parser.add_argument("--rounds", type=int, default=7)
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    sys.stdout.write(f"{machine(chosen.device, chosen.threads)}; ms a call of 8 frames, batch 1\n")
    figures: dict[str, dict[str, float]] = {}
    for dim, cells in GRIDS.items():
        scene, state = scenes(PRESETS[dim], chosen.particles, 1)
        emulators = {key: made.to(chosen.device) for key, made in combinations(scene).items()}
        found = milliseconds(emulators, state.to(chosen.device), chosen.rounds)
        figures[f"{dim}-D"] = {" + ".join(key): value for key, value in found.items()}
        sys.stdout.write(f"\n{dim}-D, {cells} cells an axis, {state.position.shape[1]} particles\n{table(found)}\n")
        sys.stdout.flush()
    write(chosen.json, figures)


if __name__ == "__main__":
    main()
