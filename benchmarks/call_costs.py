"""Time a call with every combination of network, transfer and decoder, on one scene in 2-D and in 3-D.

python benchmarks/call_costs.py --threads 1 --json call_costs.json

The networks are those of sweeps/parts.yaml, untrained and under autocast to bfloat16. The table shows networks against
transfers, and what each decoder adds to the first one; the JSON file has every combination.
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
from ablation import Sweep, build_module
from timing import describe_machine, make_timing_parser, time_alternating, write_json
from workloads import PRESETS, make_scenes

from nmpm.emulator import Emulator
from nmpm.particles import Particles
from nmpm.scene import Scene

SWEEP = Path(__file__).parent / "sweeps" / "parts.yaml"
CELLS = {2: 64, 3: 32}
TRANSFERS = ("Linear", "Nearest", "Quadratic", "Affine")
DECODERS = ("Residual", "Absolute", "Flip", "Blend", "Acceleration")
Combination = tuple[str, str, str]


def build_combinations(scene: Scene) -> dict[Combination, Emulator]:
    """An emulator for each network, transfer and decoder."""
    sweep = Sweep.read(SWEEP)
    networks = [name for name, own in sweep.variants.items() if not own or "processor" in own.get("model", {})]
    return {key: _build(sweep.config_of(key[0]), scene, *key[1:]) for key in product(networks, TRANSFERS, DECODERS)}


def _build(config: dict[str, Any], scene: Scene, transfer: str, decoder: str) -> Emulator:
    parts = {
        "transfer": {"class_path": f"nmpm.transfer.{transfer}"},
        "decoder": {"class_path": f"nmpm.decoders.{decoder}"},
    }
    model = config["model"] | parts | {"cells": CELLS[scene.dim], "constraints": {}}
    return build_module(config | {"model": model}, scene).emulator.eval().requires_grad_(False)


@torch.inference_mode()
def measure_milliseconds(
    emulators: Mapping[Combination, Emulator], state: Particles, rounds: int
) -> dict[Combination, float]:
    """Of a call, median over the rounds, in each of which all emulators run."""
    calls = {key: partial(emulator, state, emulator.context(state)) for key, emulator in emulators.items()}
    with torch.autocast(state.position.device.type, torch.bfloat16):
        seconds = time_alternating(calls, rounds)
    return {key: 1e3 * statistics.median(values) for key, values in seconds.items()}


def format_table(milliseconds: Mapping[Combination, float]) -> str:
    """A line per network, then one per decoder."""
    networks, first = list(dict.fromkeys(key[0] for key in milliseconds)), DECODERS[0]
    lines = [f"{'':28}" + "".join(f"{name:>14}" for name in TRANSFERS)]
    for network in networks:
        cells = (milliseconds[network, transfer, first] for transfer in TRANSFERS)
        lines.append(f"{network:28}" + "".join(f"{value:>14.4g}" for value in cells))
    for decoder in DECODERS[1:]:
        added = [milliseconds[n, t, decoder] - milliseconds[n, t, first] for n, t in product(networks, TRANSFERS)]
        lines.append(f"{decoder} instead of {first}: {statistics.median(added):+.2g}")
    return "\n".join(lines)


def main() -> None:
    """Measure, print the tables, and write JSON if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--particles", type=int, default=2300)
    parser.add_argument("--rounds", type=int, default=7)
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    sys.stdout.write(f"{describe_machine(chosen.device, chosen.threads)}; ms a call of 8 frames, batch 1\n")
    figures: dict[str, dict[str, float]] = {}
    for dim, cells in CELLS.items():
        scene, state = make_scenes(PRESETS[dim], chosen.particles, 1)
        emulators = {key: emulator.to(chosen.device) for key, emulator in build_combinations(scene).items()}
        found = measure_milliseconds(emulators, state.to(chosen.device), chosen.rounds)
        figures[f"{dim}-D"] = {" + ".join(key): value for key, value in found.items()}
        sys.stdout.write(
            f"\n{dim}-D, {cells} cells an axis, {state.position.shape[1]} particles\n{format_table(found)}\n"
        )
        sys.stdout.flush()
    write_json(chosen.json, figures)


if __name__ == "__main__":
    main()
