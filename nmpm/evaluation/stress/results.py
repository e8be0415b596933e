"""Results of the battery: tests that pass or fail by a stated invariant, their amount of work, and the report.

The report is a table, JSON, Markdown and a picture.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from rich.table import Table

from nmpm._support.atomic import atomic_write

_VERDICTS = {True: ("pass", "green"), False: ("FAIL", "red"), None: ("–", "dim")}


@dataclass(frozen=True)
class TestResult:
    """One test of the battery.

    Args:
        group: Kind of extreme.
        name: Name within the group.
        passed: Whether the invariant holds; None for figures that are reported without a verdict.
        figures: What was measured, by name; names end with their unit where there is one.
        needs: The invariant in words; empty where there is no verdict.
        curves: Curves to draw, by name: values evenly spaced over the rollout, and its number of frames.
    """

    group: str
    name: str
    passed: bool | None
    figures: Mapping[str, float]
    needs: str = ""
    curves: Mapping[str, tuple[Sequence[float], int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Effort:
    """Amount of work of each kind that the battery does.

    Args:
        scenes: Scenes of each kind.
        horizons: Length of the long rollouts, in training horizons.
        far: Frames of the longest rollout.
        settling: Length of the simulation after which material counts as settled, in trajectories of the preset.
        settled: Frames over which settled material must keep its volume.
        compared: Frames that are compared with the simulator.
        particles: Largest number of particles in one scene.
        bundles: Largest number of bundles that gradients go through.
        settling_scenes: Scenes of the settling rollouts: single ones scatter by a fifth.
        settling_multiples: Where their shapes are compared, in trajectories of the preset.
    """

    scenes: int
    horizons: int
    far: int
    settling: int
    settled: int
    compared: int
    particles: int
    bundles: int
    settling_scenes: int = 8
    settling_multiples: tuple[float, ...] = (1.0, 5 / 3, 5 / 2)


QUICK = Effort(scenes=2, horizons=25, far=4_000, settling=3, settled=1_600, compared=160, particles=100_000, bundles=16)
FULL = Effort(
    scenes=8,
    horizons=100,
    far=100_000,
    settling=5,
    settled=12_000,
    compared=400,
    particles=10_000_000,
    bundles=64,
    settling_multiples=(1.0, 5 / 3, 5 / 2, 20.0),
)


def _figures(result: TestResult) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in result.figures.items())


def table(title: str, results: Sequence[TestResult]) -> Table:
    """All results, a section for each group."""
    drawn = Table(title=title, title_justify="left")
    for heading in ("", "test", "measured"):
        drawn.add_column(heading, overflow="fold")
    group = ""
    for result in results:
        if result.group != group:
            group = result.group
            drawn.add_section()
            drawn.add_row("", f"[bold]{group}[/bold]", "")
        verdict, colour = _VERDICTS[result.passed]
        drawn.add_row(f"[{colour}]{verdict}[/{colour}]", result.name, _figures(result))
    return drawn


def summary(results: Sequence[TestResult]) -> str:
    """How many results passed and failed, in one sentence."""
    passed = sum(result.passed is True for result in results)
    failed = [result.name for result in results if result.passed is False]
    return f"{passed} passed, {len(failed)} failed" + (f": {'; '.join(failed)}." if failed else ".")


def as_json(subject: str, size: str, seconds: float, results: Sequence[TestResult]) -> str:
    """The whole report as JSON."""
    lines = [asdict(result) for result in results]
    return json.dumps({"model": subject, "size": size, "seconds": round(seconds, 1), "lines": lines}, indent=1)


def write(folder: Path, text: str, results: Sequence[TestResult], stem: str = "stress") -> list[Path]:
    """Write `<stem>.json`, `<stem>.md` and `<stem>.png` into a folder, which is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{stem}.{suffix}" for suffix in ("json", "md", "png")]
    with atomic_write(paths[0]) as part:
        part.write_text(text + "\n", encoding="utf-8")
    rows = ["| | test | measured | needed |", "|---|---|---|---|"]
    rows += [f"| {_VERDICTS[each.passed][0]} | {each.name} | {_figures(each)} | {each.needs} |" for each in results]
    with atomic_write(paths[1]) as part:
        part.write_text("\n".join(rows) + "\n", encoding="utf-8")
    _draw(paths[2], results)
    return paths


def _draw(path: Path, results: Sequence[TestResult]) -> None:
    """The curves, one panel each."""
    from matplotlib.figure import Figure

    curves = [(result.name, name, *curve) for result in results for name, curve in result.curves.items()]
    figure = Figure(figsize=(9, 2.6 * max(1, len(curves))), layout="constrained")
    panels = figure.subplots(max(1, len(curves)), 1, squeeze=False)[:, 0]
    for panel, (title, name, values, frames) in zip(panels, curves, strict=False):
        panel.plot([frames * (index + 1) / len(values) for index in range(len(values))], values, lw=1.2)
        panel.axhline(0, color="0.7", lw=0.8)
        panel.set(title=title, ylabel=name, xlabel="frame")
    with atomic_write(path) as part:
        figure.savefig(part, dpi=110, format="png")
