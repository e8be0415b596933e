"""Where emulation pays: what a frame of the simulators costs beside one of the emulators, against the particles.

python benchmarks/where_emulation_pays.py                          table, and map.json and map.png in benchmarks/trade
python benchmarks/where_emulation_pays.py goop dambreak2d --times 1 4 16
python benchmarks/where_emulation_pays.py --redraw                 after the trade's tables were measured again

Each preset is simulated in domains several times as wide, in which one of its initial states stands as often side by
side, on one thread; the emulator is the zoo's model of it, or an untrained one of its configuration. The cost of both
is close to linear in the particles, so their ratio is a number of substeps:

    break-even = (ms per frame of the emulator) / (ms per substep of the simulator)

Emulation pays where the cheapest stable simulation of the same error needs more substeps than that. The cost model of
the map, ms = a + b × particles, is fitted to all widths but the widest and checked on that. Presets that are not named
keep their figures in map.json, and the name of the processor on which they were measured. Points: settings of the
trade's tables (`benchmarks/trade/NAME/trade.csv`, see `beside_simulator.py`), the cheapest simulation that is no less
accurate than the model.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
import yaml
from beside_simulator import read_rivals
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rolling import roll_to_end
from timing import Spread, clock_for, make_parser, time_alternating, write_json

from nmpm._support.atomic import atomic_write
from nmpm._support.messages import counted
from nmpm._support.shipped import find_config
from nmpm.data.format import Trajectory
from nmpm.data.generate import preset_metadata
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import RecordingReader
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.calibration import calibrate
from nmpm.errors import ZooError
from nmpm.evaluation.machine import describe_device
from nmpm.particles import Window
from nmpm.sim import InitialState, Preset, load_preset
from nmpm.zoo import Zoo

TRADE = Path(__file__).parent / "trade"
WIDTHS: Mapping[str, Sequence[int]] = {
    "goop": (1, 4, 16, 512),
    "waterramps": (1, 4, 16),
    "waterdrop3d": (1, 4),
    "dambreak2d": (1, 4, 20),
    "wbcsph": (1, 3),
}
"""Presets, and how many times as wide their domains become: goop up to 10⁶ particles."""
SEEDS = 16
"""Initial states of which the one with the most particles is taken."""
FRAMES = 16
"""Frames of an emulator in a timed run."""
MOST, ROUNDS = 10**5, 3
"""So many particles or more are timed in so many rounds at most, over a frame of the simulator instead of four."""
RECIPE = ("cells", "frames", "transfer", "processor", "decoder", "constraints")


@dataclass(frozen=True)
class Case:
    """What one width costs.

    Args:
        name: Of the preset.
        times: As wide as the preset's own domain.
        particles: That move.
        solver: Of the simulator, with its number of dimensions.
        substeps: Of the preset.
        substep: Of the simulator, seconds.
        frame: Of the emulator, seconds.
        hardware: Processor.
    """

    name: str
    times: int
    particles: int
    solver: str
    substeps: int
    substep: Spread
    frame: Spread
    hardware: str

    @classmethod
    def read(cls, plain: Mapping[str, Any]) -> Self:
        """The case of an entry of map.json."""
        return cls(**{**plain, "substep": Spread(**plain["substep"]), "frame": Spread(**plain["frame"])})

    @property
    def break_even(self) -> float:
        """Substeps of the simulator that take as long as a frame of the emulator."""
        return self.frame.median / self.substep.median


def emulator_of(preset: Preset, window: Window) -> Emulator:
    """The zoo's model in the preset's domain; where there is none, an untrained one of the configuration."""
    try:
        return Zoo.load(preset.name).with_network("bfloat16").emulator.over(preset.scene)
    except ZooError:
        model = yaml.safe_load(find_config(f"{preset.name}.yaml").read_text(encoding="utf-8"))["model"]
    torch.manual_seed(0)
    own = {key: model[key] for key in RECIPE if key in model}
    spacing = EmulatorRecipe(load_preset(preset.name).scene, **own).grid.spacing
    sides = zip(preset.scene.domain, spacing, strict=True)
    own["cells"] = tuple(round((high - low) / width) for (low, high), width in sides)
    emulator = EmulatorRecipe(preset.scene, **own).build()
    calibrate(emulator, [window])
    return emulator.with_network(torch.bfloat16).eval().requires_grad_(False)


def side_by_side(preset: Preset, start: InitialState, times: int) -> InitialState:
    """The state so many times in a row, each copy a width of the preset's own domain further on."""
    width = preset.domain[0][1] - preset.domain[0][0]
    shifts = [np.array([width * copy, *[0.0] * (len(preset.domain) - 1)]) for copy in range(times)]
    ends = np.cumsum(start.counts or (len(start.position),))
    parts = [slice(first, end) for first, end in zip((0, *ends[:-1]), ends, strict=True)]  # one for each material
    return dataclasses.replace(
        start,
        position=np.concatenate([start.position[part] + shift for part in parts for shift in shifts]),
        velocity=np.concatenate([start.velocity[part] for part in parts for _ in shifts]),
        counts=tuple(times * count for count in start.counts),
        obstacles=tuple(obstacle.moved(shift) for shift in shifts for obstacle in start.obstacles),
    )


def simulate(preset: Preset, start: InitialState, frames: int) -> Window:
    """A window of so many simulated frames after the first two."""
    run = preset.simulate_from(start, frames + 1)
    stored = Trajectory(run.position, run.particle_type, run.attributes)
    return collate(
        [RecordingReader(preset_metadata(preset), preset.scene).recording(stored, preset.name)], preset.scene
    )


def measure(name: str, times: int, rounds: int) -> Case:
    """Time a preset's simulator and emulator in a domain so many times as wide, taking turns.

    A substep is timed by the difference of two simulations, so that what precedes the first one is left out.
    """
    own = load_preset(name)
    preset = own if times == 1 else own.widened(times)
    start = side_by_side(own, max(map(own.draw, range(SEEDS)), key=lambda drawn: len(drawn.position)), times)
    many = len(start.position) >= MOST
    frames = 1 if many else 4
    window = simulate(preset, start, 1 if name in Zoo.list() else FRAMES)
    actions = {
        "one": lambda: preset.simulate_from(start, 1),
        "more": lambda: preset.simulate_from(start, 1 + frames),
        "emulator": emulation(emulator_of(preset, window), window),
    }
    rounds = min(rounds, ROUNDS) if many else rounds
    seconds = time_alternating(actions, rounds, clock_for(torch.device("cpu")), warm_up=0 if many else 1)
    pairs = zip(seconds["more"], seconds["one"], strict=True)
    substep = [(more - one) / frames / preset.substeps for more, one in pairs]
    frame = [value / FRAMES for value in seconds["emulator"]]
    solver, hardware = f"{preset.generator}, {len(preset.box)}-D", describe_device(torch.device("cpu"))
    spreads = Spread.of(substep), Spread.of(frame)
    if spreads[0].median <= 0:
        raise SystemExit(f"{name} × {times}: two simulations differ by less than the noise; give more --rounds.")
    return Case(name, times, len(start.position), solver, preset.substeps, *spreads, hardware)


def emulation(emulator: Emulator, window: Window) -> Callable[[], None]:
    """Roll out `FRAMES` frames from a window's start; compiled already."""
    context = emulator.context(window.initial)

    def emulate() -> None:
        with torch.inference_mode():
            roll_to_end(lambda particles: emulator(particles, context), window.initial, FRAMES // emulator.frames)

    emulate()
    return emulate


def fit_cost(cases: Sequence[Case], seconds: Sequence[float]) -> dict[str, float]:
    """The line a + b × particles through all but the widest case.

    Returns:
        offset: a, seconds.
        slope: b, seconds per particle.
        misfit: The largest relative distance of a fitted case from the line.
        check: The widest case's cost over that of the line.
    """
    counts = np.array([case.particles for case in cases], dtype=float)
    values = np.array(seconds)
    weights = 1 / values[:-1]  # relative errors count
    matrix = np.stack([np.ones(len(counts) - 1), counts[:-1]], axis=1)
    offset, slope = np.linalg.lstsq(matrix * weights[:, None], values[:-1] * weights, rcond=None)[0]
    ratios = values / (offset + slope * counts)
    misfit, check = float(np.abs(ratios[:-1] - 1).max()), float(ratios[-1])
    return {"offset": offset, "slope": slope, "misfit": misfit, "check": check}


def equal_error(name: str) -> dict[str, Any] | None:
    """From a trade's table: the most accurate model, and the cheapest stable simulation that is no less accurate."""
    path = TRADE / name / "trade.csv"
    rivals = read_rivals(path) if path.is_file() else []
    if not rivals:
        return None
    best = min(rivals, key=lambda rival: rival.model.error)
    return {
        "name": name,
        "particles": best.particles,
        "model": best.model.name,
        "simulator": best.as_good.name,
        "speed_up": best.speed_up,
    }


def draw(axes: Axes, name: str, cases: Sequence[Case]) -> None:
    """Milliseconds per frame against particles: emulator, simulator as shipped, and per substep."""
    counts = [case.particles for case in cases]
    axes.plot(counts, [1e3 * case.frame.median for case in cases], "o-", label="emulator")
    for substeps in (1, 10, 100):
        times = [1e3 * substeps * case.substep.median for case in cases]
        axes.plot(counts, times, "--", color="0.6", linewidth=1)
        axes.annotate(counted(substeps, "substep"), (counts[-1], times[-1]), fontsize=7, ha="right")
    shipped = [1e3 * case.substeps * case.substep.median for case in cases]
    axes.plot(counts, shipped, "s-", label=f"simulator, {cases[0].substeps} substeps")
    axes.set(xscale="log", yscale="log", xlabel="thousand particles", ylabel="ms per frame")
    axes.set_title(f"{name}: {cases[0].solver}")
    axes.set_xticks(counts, [f"{count / 1000:,.0f}" for count in counts])
    axes.set_xticks([], minor=True)
    axes.legend(frameon=False, fontsize="small")


def write_map(cases: Mapping[str, Sequence[Case]], path: Path) -> None:
    """The picture: a panel per preset."""
    figure = Figure(figsize=(3.6 * len(cases), 3.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, rows) in zip(figure.subplots(1, len(cases), squeeze=False)[0], cases.items(), strict=True):
        draw(axes, name, rows)
    with atomic_write(path) as part:
        figure.savefig(part, format="png")


def figures(cases: Mapping[str, Sequence[Case]]) -> dict[str, Any]:
    """The cases, the fitted costs of presets with three widths or more, and points of the trade's tables."""
    costs = {
        name: {
            "emulator": fit_cost(rows, [case.frame.median for case in rows]),
            "substep": fit_cost(rows, [case.substep.median for case in rows]),
        }
        for name, rows in cases.items()
        if len(rows) > 2
    }
    tables = sorted(path.parent.name for path in TRADE.glob("*/trade.csv"))
    points = [point for name in tables if (point := equal_error(name)) is not None]
    return {"cases": [asdict(case) for rows in cases.values() for case in rows], "costs": costs, "points": points}


def table_lines(cases: Mapping[str, Sequence[Case]], found: Mapping[str, Any]) -> Iterator[str]:
    """A Markdown table of the cases, then what was fitted and what the trade's tables say."""
    yield "| preset | solver | particles | ms per substep | ms per frame, emulator | break-even, substeps | on |"
    yield "|---|---|---:|---:|---:|---:|---|"
    for case in (case for rows in cases.values() for case in rows):
        yield (
            f"| {case.name} × {case.times} | {case.solver} | {case.particles:,} | {case.substep.format()} |"
            f" {case.frame.format()} | {case.break_even:.2g} of {case.substeps} | {case.hardware} |"
        )
    for name, cost in found["costs"].items():
        checks = ", ".join(f"{part} {fit['check']:.2f} (others {fit['misfit']:.0%} off)" for part, fit in cost.items())
        yield f"{name}: the widest case over the fitted line: {checks}"
    for point in found["points"]:
        yield f"{point['name']}: {point['model']} is {point['speed_up']:.2g} times as fast as {point['simulator']}"


def read_cases(path: Path) -> dict[str, list[Case]]:
    """The cases of an earlier map.json by preset; none if there is no such file."""
    cases: dict[str, list[Case]] = {}
    for plain in json.loads(path.read_text(encoding="utf-8"))["cases"] if path.is_file() else ():
        cases.setdefault(plain["name"], []).append(Case.read(plain))
    return cases


def main() -> None:
    """Measure, print, and write JSON and a picture."""
    parser = make_parser(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"presets (default: all), of {', '.join(WIDTHS)}")
    parser.add_argument("--times", type=int, nargs="+", help="widths of the domain (default: the preset's own list)")
    parser.add_argument("--rounds", type=int, default=7, help="timed runs of each")
    parser.add_argument("--out", type=Path, default=TRADE, help="folder of map.json and map.png")
    parser.add_argument(
        "--redraw", action="store_true", help="measure nothing: the figures kept, the tables' points anew"
    )
    chosen: Namespace = parser.parse_args()
    for name in set(chosen.names) - set(WIDTHS):  # (`choices` of `nargs="*"` would refuse that none is given)
        parser.error(f"{name!r} is not one of {', '.join(WIDTHS)}.")
    torch.set_num_threads(1)
    cases = read_cases(chosen.out / "map.json")
    for name in () if chosen.redraw else chosen.names or WIDTHS:
        cases[name] = []
        for times in chosen.times or WIDTHS[name]:
            cases[name].append(measure(name, times, chosen.rounds))
            write_json(chosen.out / "map.json", figures(cases))  # kept if a wider case is interrupted
    found = figures(cases)
    write_json(chosen.out / "map.json", found)
    sys.stdout.write("\n".join(table_lines(cases, found)) + "\n")
    write_map(cases, chosen.out / "map.png")


if __name__ == "__main__":
    main()
