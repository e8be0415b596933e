"""Models beyond their own scenes: four times as many particles, a domain twice as wide, and time against particles.

python benchmarks/generalisation.py                              waterramps and waterdrop of the zoo
python benchmarks/generalisation.py --models waterramps waterdrop waterdrop-xl --out benchmarks/generalisation
python benchmarks/generalisation.py --models runs/mine --data waterramps --wider waterramps --particles 1e3 1e5
python benchmarks/generalisation.py --data --wider --particles 1e3 1e4 1e5      times alone

For each dataset of --data and --wider this is `nmpm compare`, which writes to a folder each, and measures only what is
new. Then one scene of more and more, ever smaller particles in the same box is rolled out by each model on its own
grid, and by the simulators of --presets: on their own grid, and on one that is as fine as the particles, with as many
more substeps. Written are times.json and times.png. On the CPU times are processor time.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from timing import Spread, clock_for, describe_machine, make_timing_parser, time_alternating, write_json

from nmpm._support.atomic import atomic_write
from nmpm.cli import main as run_command
from nmpm.data.initial_states import thrown_blocks
from nmpm.scene import Scene
from nmpm.sim import InitialState, MpmPreset, Preset, load_preset
from nmpm.zoo import Pretrained, load_model

FILLED = 0.2
"""Share of the box that the particles fill at most; smaller particles where there are more."""
BUNDLES = 3
"""Bundles of a timed rollout of a model."""
SIMULATED = 2
"""Frames of a timed simulation."""


def compare_on(models: Sequence[str], out: Path, name: str, words: Sequence[str]) -> None:
    """Run `nmpm compare` with other words, into a folder."""
    status = run_command(["compare", *models, *words, "--out", str(out / name)])
    if status:
        raise SystemExit(status)


def measure_times(
    models: Mapping[str, Pretrained], presets: Sequence[MpmPreset], count: int, rounds: int, device: torch.device
) -> dict[str, Spread]:
    """Seconds per frame of each model and simulator in its box with so many particles, all in turn."""
    timed: dict[str, _Rollout | _Simulation] = {name: _Rollout(model, count) for name, model in models.items()}
    for preset in presets:
        timed[f"simulator of {preset.name}, own grid"] = _Simulation(preset, count)
        timed[f"simulator of {preset.name}, grid as fine as the particles"] = _Simulation(refine(preset, count), count)
    seconds = time_alternating(timed, rounds, clock_for(device), warm_up=1)
    return {name: Spread.of([second / timed[name].frames for second in taken]) for name, taken in seconds.items()}


def refine(preset: MpmPreset, count: int) -> MpmPreset:
    """The preset with cells and substeps in proportion to the spacing of so many particles, where that is smaller."""
    factor = max(1.0, preset.spacing / _shrink(preset.scene, count).particle_spacing)
    many = dataclasses.replace(preset, substeps=2**31, cells=round(factor * preset.cells))
    return dataclasses.replace(many, substeps=math.ceil(factor * preset.substeps))


def _shrink(scene: Scene, count: int) -> Scene:
    """The scene with particles small enough that so many fill no more than the share of the box."""
    volume = min(scene.particle_volume, FILLED * scene.volume / count)
    return dataclasses.replace(scene, particle_volume=volume)


class _Rollout:
    """A rollout of thrown blocks of particles.

    Args:
        model: What rolls out.
        count: Approximate number of particles.
    """

    def __init__(self, model: Pretrained, count: int) -> None:
        finer = _shrink(model.scene, count)
        self.model, self.state = model.over(finer), thrown_blocks(finer, count=count, blocks=2, seed=0)
        self.frames = BUNDLES * model.emulator.frames

    def __call__(self) -> object:
        return self.model.rollout(self.state, self.frames)


class _Simulation:
    """A simulation of the same blocks, in the preset's box.

    Args:
        preset: Simulates.
        count: Approximate number of particles.
    """

    def __init__(self, preset: MpmPreset, count: int) -> None:
        finer = _shrink(preset.scene, count)
        state = thrown_blocks(finer, count=count, blocks=2, seed=0)
        velocity = state.velocity[0].double().numpy() / preset.frame_dt
        self.start = InitialState(state.position[0].double().numpy(), velocity)
        self.preset: Preset = dataclasses.replace(preset, spacing=finer.particle_spacing)
        self.frames = SIMULATED

    def __call__(self) -> object:
        return self.preset.simulate_from(self.start, self.frames)


def draw_times(path: Path, rows: Mapping[int, Mapping[str, Spread]]) -> None:
    """Write a PNG of milliseconds per frame against particles; simulators are dashed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name in next(iter(rows.values())):
        style = "s--" if "simulator" in name else "o-"
        axes.plot(list(rows), [1e3 * row[name].median for row in rows.values()], style, ms=4, label=name)
    axes.set(xscale="log", yscale="log", xlabel="particles", ylabel="ms per frame, one scene")
    axes.grid(visible=True, color="0.92", lw=0.6)
    axes.legend(frameon=False, fontsize="small")
    with atomic_write(path) as part:
        figure.savefig(part, format="png")


def load_mpm(name: str) -> MpmPreset:
    """A shipped preset, which must be of the material point method."""
    preset = load_preset(name)
    if not isinstance(preset, MpmPreset):
        raise SystemExit(
            f"--presets {name}: only simulators of the material point method are timed; it is {preset.solver}."
        )
    return preset


def time_all(
    models: Mapping[str, Pretrained],
    presets: Sequence[MpmPreset],
    counts: Sequence[int],
    rounds: int,
    device: torch.device,
) -> dict[int, dict[str, Spread]]:
    """Print and return times by number of particles."""
    rows: dict[int, dict[str, Spread]] = {}
    for count in counts:
        rows[count] = measure_times(models, presets, count, rounds, device)
        sys.stdout.write(f"{count} particles\n")
        sys.stdout.writelines(f"  {name:<58}{spread.format()}\n" for name, spread in rows[count].items())
        sys.stdout.flush()
    return rows


def main() -> None:
    """Compare, then time."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--models", nargs="+", default=["waterramps", "waterdrop"])
    parser.add_argument("--data", nargs="*", default=["waterdrop-xl", "waterramps"], help="names, or folders")
    parser.add_argument("--wider", nargs="*", default=["waterramps"], help="embedded datasets, twice as wide")
    parser.add_argument("--presets", nargs="*", default=["waterramps"], help="whose simulators (MPM) are timed")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/generalisation"))
    parser.add_argument("--particles", type=float, nargs="*", default=[1e3, 1e4, 1e5])
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    common = ["--scenes", str(chosen.scenes), "--device", str(chosen.device)]
    wanted = {Path(name).name: ["--data", name] for name in chosen.data}
    wanted |= {f"{name}-wider": ["--data", name, "--wider", "2"] for name in chosen.wider}
    for name, words in wanted.items():
        compare_on(chosen.models, chosen.out, name, [*words, *common])
    if not chosen.particles:
        return
    models = {Path(name).name: load_model(name, chosen.device) for name in chosen.models}
    presets = [load_mpm(name) for name in chosen.presets]
    machine = describe_machine(chosen.device, chosen.threads)
    sys.stdout.write(f"{machine}; milliseconds per frame, median (range)\n")
    rows = time_all(models, presets, [round(count) for count in chosen.particles], chosen.rounds, chosen.device)
    write_json(chosen.out / "times.json", {"machine": machine, "times": rows})
    draw_times(chosen.out / "times.png", rows)


if __name__ == "__main__":
    main()
