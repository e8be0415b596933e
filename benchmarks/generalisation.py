"""Models beyond their own scenes: four times as many particles, a domain twice as wide, and time against particles.

python benchmarks/generalisation.py                              waterramps and waterdrop of the zoo
python benchmarks/generalisation.py --models waterramps waterdrop waterdrop-xl --out benchmarks/generalisation
python benchmarks/generalisation.py --models runs/mine --data waterramps --wider waterramps --particles 1e3 1e5

For each dataset of --data and --wider this is `nmpm compare`, which writes to a folder each, and measures only what is
new. Then one scene of more and more, ever smaller particles in the same box is rolled out by each model: times.json and
times.png.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from timing import Spread, describe_machine, make_timing_parser, time_alternating, write_json

from nmpm._support.atomic import atomic_write
from nmpm.cli import main as run_command
from nmpm.data.initial_states import thrown_blocks
from nmpm.zoo import Pretrained, load_model

FILLED = 0.2
"""Share of the box that the particles fill at most; smaller particles where there are more."""
BUNDLES = 3
"""Bundles of a timed rollout."""


def compare_on(models: Sequence[str], out: Path, name: str, words: Sequence[str]) -> None:
    """Run `nmpm compare` with other words, into a folder."""
    status = run_command(["compare", *models, *words, "--out", str(out / name)])
    if status:
        raise SystemExit(status)


def measure_times(models: Mapping[str, Pretrained], count: int, rounds: int) -> dict[str, Spread]:
    """Seconds per frame of each model in its box with so many particles, all models in turn."""
    return {
        name: Spread.of([second / _frames(models[name]) for second in seconds])
        for name, seconds in time_alternating(
            {name: _Rollout(model, count) for name, model in models.items()}, rounds, warm_up=1
        ).items()
    }


def _frames(model: Pretrained) -> int:
    return BUNDLES * model.emulator.frames


class _Rollout:
    """A rollout of thrown blocks of particles.

    Args:
        model: What rolls out.
        count: Approximate number of particles.
    """

    def __init__(self, model: Pretrained, count: int) -> None:
        scene = model.scene
        volume = min(scene.particle_volume, FILLED * scene.volume / count)
        finer = dataclasses.replace(scene, particle_volume=volume)
        self.model, self.state = model.over(finer), thrown_blocks(finer, count=count, blocks=2, seed=0)

    def __call__(self) -> object:
        return self.model.rollout(self.state, _frames(self.model))


def draw_times(path: Path, rows: Mapping[int, Mapping[str, Spread]], simulated: Mapping[int, float]) -> None:
    """Write a PNG of milliseconds per frame against particles; simulators as far as comparisons timed them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6, 3.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name in next(iter(rows.values())):
        axes.plot(list(rows), [1e3 * row[name].median for row in rows.values()], ".-", label=name)
    if simulated:
        axes.plot(list(simulated), list(simulated.values()), "s", color="#c8642a", mfc="none", label="simulator")
    axes.set(xscale="log", yscale="log", xlabel="particles", ylabel="ms per frame, one scene")
    axes.grid(visible=True, color="0.92", lw=0.6)
    axes.legend(frameon=False, fontsize="small")
    with atomic_write(path) as part:
        figure.savefig(part, format="png")


def simulator_times(folders: Sequence[Path]) -> dict[int, float]:
    """Milliseconds per frame of the simulators, by mean number of particles, as comparisons wrote them."""
    found: dict[int, float] = {}
    for folder in folders:
        stated: dict[str, Any] = json.loads((folder / "compare.json").read_text(encoding="utf-8"))
        times = [one["ms_per_frame"]["median"] for one in stated["predictors"] if one["kind"] == "simulator"]
        found |= {round(sum(stated["particles"]) / len(stated["particles"])): time for time in times if time}
    return dict(sorted(found.items()))


def main() -> None:
    """Compare, then time."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--models", nargs="+", default=["waterramps", "waterdrop"])
    parser.add_argument("--data", nargs="*", default=["waterdrop-xl", "waterramps"], help="names, or folders")
    parser.add_argument("--wider", nargs="*", default=["waterramps"], help="embedded datasets, twice as wide")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/generalisation"))
    parser.add_argument("--particles", type=float, nargs="*", default=[1e3, 1e4, 1e5, 1e6])
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
    rows: dict[int, dict[str, Spread]] = {}
    sys.stdout.write(f"{describe_machine(chosen.device, chosen.threads)}; milliseconds per frame, median (range)\n")
    for count in map(round, chosen.particles):
        rows[count] = measure_times(models, count, chosen.rounds)
        figures = "  ".join(f"{name} {spread.format()}" for name, spread in rows[count].items())
        sys.stdout.write(f"{count:<10}{figures}\n")
        sys.stdout.flush()
    write_json(chosen.out / "times.json", {"machine": describe_machine(chosen.device, chosen.threads), "times": rows})
    draw_times(chosen.out / "times.png", rows, simulator_times([chosen.out / name for name in wanted]))


if __name__ == "__main__":
    main()
