"""Cost against what a scene holds: with everything that saves, and without, alternating in one run.

python benchmarks/scene_costs.py --threads 1 --json scene_costs.json --figure benchmarks/scene_costs.png
python benchmarks/scene_costs.py --sweeps rest errors --cases goop
python benchmarks/scene_costs.py --redraw scene_costs.json --figure benchmarks/scene_costs.png

"On" is what rollouts do by themselves: kernels, no calls for what is at rest. "Off" are
tensor operations on the whole grid, bundle after bundle. CPU time in ms, median (quartiles). Water or goop lies in a
corner; its sides are the same part of the box's. The channel is waterramps' model on a box of 8:1; where times are
measured, waterdrop3d's network is untrained, which costs as much. Errors are those of zoo models, the channel's on
waterramps' scenes in a box 8 times as wide.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from rolling import roll_on
from timing import clock_for, describe_machine, make_timing_parser, time_alternating, write_json
from torch import Tensor
from windows import build_emulator as build_wider
from windows import fill
from workloads import DEFAULT_SETUP, SETUPS
from workloads import build_emulator as build_untrained

from nmpm.emulator import Bundle, Emulator, unroll
from nmpm.evaluation.stress.model import ModelUnderTest, simulate_beside
from nmpm.particles import Particles
from nmpm.sim import load_preset
from nmpm.transfer import without_kernels
from nmpm.zoo import Zoo

Row = dict[str, Any]
ROLLOUT = 50
"""Bundles of a rollout: 400 frames, as the trajectories of goop have."""
LATE = 5
"""The scene of goop that is followed: it comes to rest late."""
ERROR_FRAMES = {"goop": 399, "waterramps": 599, "channel": 599, "waterdrop3d": 799}
ROUNDING = 1e-7
"""Of the nudge, in domain length."""


def build_goop(cells: int = 32) -> Emulator:
    """The zoo's, on its own grid or on a larger or smaller one with its cells' size."""
    trained = Zoo.load("goop").emulator
    scene, part = trained.scene, cells / trained.grid.shape[0]
    walls = [(low - outer[0], outer[1] - high) for (low, high), outer in zip(scene.bounds, scene.domain, strict=True)]
    domain = tuple((low, low + (high - low) * part) for low, high in scene.domain)
    bounds = tuple((low + first, high - last) for (low, high), (first, last) in zip(domain, walls, strict=True))
    return trained.over(dataclasses.replace(scene, domain=domain, bounds=bounds))


def build_water3d(cells: int = 32) -> Emulator:
    """An untrained network on the box of waterdrop3d, without constraints."""
    return build_untrained(SETUPS[DEFAULT_SETUP], load_preset("waterdrop3d").scene, 32, (cells,) * 3).eval()


CASES: Mapping[str, Callable[[], Emulator]] = MappingProxyType(
    {
        "goop": build_goop,
        "waterramps": lambda: build_wider("waterramps", (64, 64), "float32"),
        "channel": lambda: build_wider("waterramps", (512, 64), "float32"),
        "waterdrop3d": build_water3d,
    }
)
"""Emulators on the grids that sweeps other than that of grids use."""

GRIDS: Mapping[str, Mapping[str, Callable[[], Emulator]]] = MappingProxyType(
    {
        "goop": {f"{n} x {n}": lambda n=n: build_goop(n) for n in (32, 64, 128)},
        "waterramps": {
            f"{n} x {n}": lambda n=n: build_wider("waterramps", (n, n), "float32") for n in (32, 64, 128, 256)
        },
        "channel": {f"{8 * n} x {n}": lambda n=n: build_wider("waterramps", (8 * n, n), "float32") for n in (32, 64)},
        "waterdrop3d": {f"{n} x {n} x {n}": lambda n=n: build_water3d(n) for n in (16, 32)},
    }
)


def finer(emulator: Emulator, share: float, count: int) -> Emulator:
    """The emulator for particles so small that about `count` of them fill this share of the box."""
    scene = emulator.scene
    return emulator.over(dataclasses.replace(scene, particle_volume=share * scene.volume / count))


@torch.no_grad()
def time_call(emulator: Emulator, state: Particles, rounds: int) -> Row:
    """CPU seconds of a call, on and off."""
    context = emulator.context(state)

    def without() -> None:
        with without_kernels():
            emulator(state, context)

    actions = {"on": lambda: emulator(state, context), "off": without}
    return {"particles": state.position.shape[1], **time_alternating(actions, rounds, clock_for(emulator.device), 2)}


@torch.no_grad()
def roll_out_plainly(emulator: Emulator, particles: Particles, bundles: int) -> list[Bundle]:
    """A rollout with everything off."""
    with without_kernels():
        context = emulator.context(particles)
        return [bundle for bundle, _ in roll_on(lambda state: emulator(state, context), particles, bundles)]


@torch.no_grad()
def roll_out(emulator: Emulator, particles: Particles, bundles: int) -> list[Bundle]:
    """A rollout as it is."""
    return list(unroll(emulator, particles, bundles))


@torch.no_grad()
def states_before_rest(emulator: Emulator, start: Particles) -> list[Particles]:
    """The states of a rollout up to the first that its bundle leaves as it is; all, if it never rests."""
    context, states = emulator.context(start), [start]
    for _, after in roll_on(lambda state: emulator(state, context), start, 2 * ROLLOUT):
        if torch.equal(after.position, states[-1].position) and torch.equal(after.velocity, states[-1].velocity):
            break
        states.append(after)
    return states


def sweep_shares(case: str, chosen: argparse.Namespace) -> Iterator[Row]:
    """A call, against the share of the box that is filled."""
    emulator = CASES[case]().requires_grad_(False)
    for share in chosen.shares:
        yield {"at": f"{share:.0%}", "x": share, **time_call(emulator, fill(emulator, share), chosen.rounds)}


def sweep_particles(case: str, chosen: argparse.Namespace) -> Iterator[Row]:
    """A call with 15% of the box filled, against the number of particles."""
    emulator = CASES[case]().requires_grad_(False)
    for count in map(round, chosen.particles):
        own = finer(emulator, 0.15, count)
        yield {"at": f"{count:.0e}", "x": count, **time_call(own, fill(own, 0.15), min(chosen.rounds, 3))}


def sweep_grids(case: str, chosen: argparse.Namespace) -> Iterator[Row]:
    """A call with 15% of the box filled, against the size of the grid."""
    for name, build in GRIDS[case].items():
        emulator = build().requires_grad_(False)
        row = time_call(emulator, fill(emulator, 0.15), min(chosen.rounds, 5))
        yield {"at": name, "x": emulator.grid.size, **row}


def sweep_rest(case: str, chosen: argparse.Namespace) -> Iterator[Row]:
    """A rollout of 50 bundles, against the bundle in which the scene comes to rest; goop alone does."""
    if case != "goop":
        return
    emulator = CASES[case]().requires_grad_(False)
    starts = ModelUnderTest(case, emulator, 32, load_preset(case)).starts(LATE + 1)
    states = states_before_rest(emulator, starts.scenes(slice(LATE, LATE + 1)))
    for index in sorted({max(0, len(states) - 1 - bundles) for bundles in (0, 10, 20, 30, 50)}, reverse=True):
        actions = {
            "on": lambda start=states[index]: roll_out(emulator, start, ROLLOUT),
            "off": lambda start=states[index]: roll_out_plainly(emulator, start, ROLLOUT),
        }
        rest = len(states) - 1 - index
        row = time_alternating(actions, min(chosen.rounds, 3), clock_for(emulator.device), 0)
        yield {"at": f"bundle {rest}", "x": rest, "particles": states[0].position.shape[1], **row}


@torch.no_grad()
def measure_errors(case: str, scenes: int) -> Row:
    """Mean squared errors of full rollouts over fresh scenes, on, off, and off from positions nudged by rounding."""
    preset = load_preset("waterramps").widened(8) if case == "channel" else load_preset(case)
    emulator = Zoo.load(preset.name).emulator.over(preset.scene).requires_grad_(False)
    frames = ERROR_FRAMES[case]
    errors: dict[str, list[float]] = {"on": [], "off": [], "nudged": []}
    for (window,) in simulate_beside(ModelUnderTest(case, emulator, 32, preset), preset, scenes, frames, ()):
        count = -(-frames // emulator.frames)
        paths = {
            "on": unroll(emulator, window.initial, count),
            "off": roll_out_plainly(emulator, window.initial, count),
            "nudged": roll_out_plainly(emulator, nudge(window.initial), count),
        }
        for name, bundles in paths.items():
            errors[name].append(_error(torch.cat([bundle.position for bundle in bundles], 1), window.target))
        latest = "   ".join(f"{values[-1]:.6g} {name}" for name, values in errors.items())
        sys.stdout.write(f"          {case:14}{latest}\n")
        sys.stdout.flush()
    return {"case": case, "scenes": scenes, **{name: statistics.mean(values) for name, values in errors.items()}}


def nudge(particles: Particles) -> Particles:
    """Particles moved by about as much as float32 rounds positions."""
    noise = torch.randn(particles.position.shape, generator=torch.Generator().manual_seed(0))
    return dataclasses.replace(particles, position=particles.position + ROUNDING * noise)


def _error(path: Tensor, target: Tensor) -> float:
    return float((path[:, : target.shape[1]] - target).square().mean())


SWEEPS: Mapping[str, Callable[[str, argparse.Namespace], Iterator[Row]]] = MappingProxyType(
    {"shares": sweep_shares, "particles": sweep_particles, "grids": sweep_grids, "rest": sweep_rest}
)
AXES = {"shares": "occupied share", "particles": "particles", "grids": "cells", "rest": "bundle of rest, of 50"}


def format_row(sweep: str, row: Row) -> str:
    """A line of the table."""
    texts = {name: _format_spread(row[name]) for name in ("on", "off")}
    ratio = statistics.median(row["off"]) / statistics.median(row["on"])
    return (
        f"{sweep:10}{row['case']:14}{row['at']:>16}{row['particles']:>10}{texts['on']:>28}{texts['off']:>28}"
        f"{ratio:>7.2f}x\n"
    )


def _format_spread(seconds: list[float]) -> str:
    low, middle, high = (1e3 * value for value in statistics.quantiles(seconds, n=4, method="inclusive"))
    return f"{middle:.3g} ({low:.3g}-{high:.3g})"


def draw(rows: list[Row], path: Path) -> None:
    """A panel for each sweep: medians against what is varied, solid with everything on, dashed without."""
    from matplotlib import pyplot
    from matplotlib.lines import Line2D

    sweeps = list(dict.fromkeys(row["sweep"] for row in rows))
    size = (4 * len(sweeps), 3.6)
    figure, panels = pyplot.subplots(1, len(sweeps), figsize=size, squeeze=False, layout="constrained")
    colours = dict(zip(CASES, ("tab:green", "tab:blue", "tab:orange", "tab:red"), strict=True))
    for panel, sweep in zip(panels[0], sweeps, strict=True):
        for case in dict.fromkeys(row["case"] for row in rows if row["sweep"] == sweep):
            own = [row for row in rows if (row["sweep"], row["case"]) == (sweep, case)]
            for name, style in (("on", "-"), ("off", "--")):
                times = [1e3 * statistics.median(row[name]) for row in own]
                panel.plot([row["x"] for row in own], times, style, marker=".", color=colours[case])
        panel.set(xlabel=AXES[sweep], ylabel="ms a rollout" if sweep == "rest" else "ms a call", yscale="log")
        panel.set_xscale("log" if sweep in ("particles", "grids") else "linear")
    names = dict.fromkeys(row["case"] for row in rows)
    lines = [Line2D([], [], color=colours[name], marker=".", label=name) for name in names]
    lines += [Line2D([], [], color="0.3", linestyle=style, label=name) for name, style in (("on", "-"), ("off", "--"))]
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines), fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def main() -> None:
    """Measure, print the table, and write figures if asked to."""
    parser = make_timing_parser(__doc__)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--sweeps", nargs="+", choices=[*SWEEPS, "errors"], default=[*SWEEPS, "errors"])
    parser.add_argument("--shares", type=float, nargs="+", default=[0.05, 0.15, 0.3, 0.6, 1.0])
    parser.add_argument("--particles", type=float, nargs="+", default=[1e3, 1e4, 1e5, 1e6])
    parser.add_argument("--scenes", type=int, default=4, help="whose errors are compared")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--figure", type=Path, help="draw the times to this file")
    parser.add_argument(
        "--redraw", type=Path, metavar="JSON", help="draw the times of an earlier --json; measure nothing"
    )
    chosen = parser.parse_args()
    if chosen.redraw is not None:
        draw(json.loads(chosen.redraw.read_text(encoding="utf-8"))["times"], chosen.figure or Path("scene_costs.png"))
        return
    torch.set_num_threads(chosen.threads)
    sys.stdout.write(f"{describe_machine(torch.device('cpu'), chosen.threads)}\n")
    rows: list[Row] = []
    for sweep in (name for name in chosen.sweeps if name in SWEEPS):
        for case in chosen.cases:
            for row in SWEEPS[sweep](case, chosen):
                rows.append({"sweep": sweep, "case": case, **row})
                sys.stdout.write(format_row(sweep, rows[-1]))
                sys.stdout.flush()
    errors = [
        measure_errors(case, chosen.scenes)
        for case in chosen.cases
        if "errors" in chosen.sweeps and case in ERROR_FRAMES
    ]
    for row in errors:
        found = ", ".join(f"{row[name]:.6g} {name}" for name in ("on", "off", "nudged"))
        sys.stdout.write(f"errors    {row['case']:14}{found}\n")
    write_json(chosen.json, {"times": rows, "errors": errors})
    if chosen.figure and rows:
        draw(rows, chosen.figure)


if __name__ == "__main__":
    main()
