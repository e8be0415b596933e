"""What is written for readers: an entry's README and chart, and the page of a zoo's models."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined, TemplateError

from nmpm._support.bounded_files import read_yaml
from nmpm._support.messages import one_line
from nmpm.emulator import EmulatorRecipe
from nmpm.errors import DataError, ZooError
from nmpm.evaluation.figures import (
    ENSEMBLE_COLUMNS,
    PREDICTORS,
    Unit,
    ensemble_rows,
    ensemble_title,
    figures_unit,
    with_unit,
)
from nmpm.zoo.card import CONFIG, FACTOR, fastest_time, lifecycle, read_card, stated_milliseconds, trivial_error
from nmpm.zoo.entries import read_recipe
from nmpm.zoo.speed_table import speed_tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CHART = "chart.png"
PICTURES = {
    CHART: "errors over frames and over training",
    "rollout.png": "rollout",
    "worst.png": "the test scene with the largest error",
}
"""An entry's pictures, with their captions."""
CONSTRAINTS = {
    "energy": "energy never exceeds that of the first state",
    "rest_speed": "particles on firm ground slower than {value:g} cells per frame stay where they are",
    "solids": "no particle enters an obstacle",
    "density_cap": "cells with a volume fraction above {value:g} spread",
    "bounds": "no particle leaves the scene's bounds ({value})",
}
"""What each constraint enforces, by its key in the card."""
QUALITY = {
    "emd": ("earth mover's distance", 1e3, " ×10⁻³"),
    "kinetic": ("kinetic energy off by", 100, "%"),
    "height": ("height of the last frame's material off by", 100, "%"),
    "crowding": ("particles per occupied cell off by", 100, "%"),
}
"""Further errors: name, factor and unit, by their key in the card."""
OPTIONAL = (
    *("about", "twin", "floor", "quality", "ensemble", "speed", "trade", "stress", "stress_free", "trust"),
    *("failures", "weights", "license", "sha256"),
)
"""Keys that a card may lack."""
PLAIN = "eager float32"
"""Runtime and precision of a model as `Zoo.load` gives it."""
COLUMNS = {"mse@100": "frames 1 – 100", "mse": "all frames"}
_TEMPLATES = Environment(
    loader=PackageLoader("nmpm.zoo"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    autoescape=False,  # noqa: S701 (Markdown)
)


@contextmanager
def complete_card(name: object) -> Iterator[None]:
    """Raise ZooError where a card, or a table beside it, lacks something or has other kinds of values."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, TemplateError) as error:
        raise ZooError(
            f"The card of {name} or a table beside it is not complete ({type(error).__name__}: {one_line(error)}):"
            f" `nmpm zoo card {name} --yaml` shows what it has; `nmpm zoo add` writes a new one from the run."
        ) from error


def entry_page(card: Mapping[str, Any], files: Collection[str] = (), load: str | None = None) -> str:
    """The README of an entry, as Markdown.

    Args:
        card: The content of `card.yaml`.
        files: Names of the entry's files; pictures among them are shown.
        load: What `Zoo.load` takes; the model's name when left out.
    """
    unit, count = figures_unit(card["test"]), card["test_scenes"]
    ensemble = card["ensemble"] if "scores" in (card.get("ensemble") or {}) else None
    return _TEMPLATES.get_template("entry.md").render(
        card={**dict.fromkeys(OPTIONAL), **card},
        state=lifecycle(card),
        factor=f"{FACTOR:g}",
        unit=str(unit),
        unit_of=with_unit,
        columns={name: text for name, text in COLUMNS.items() if name in card["test"]},
        errors=list(_error_rows(card, unit)),
        scenes="one test scene" if count == 1 else f"{count} test scenes",
        unstable=(card.get("floor") or {}).get("unstable"),
        quality=list(_quality(card.get("quality") or {})),
        ensemble=ensemble and ensemble_title(ensemble),
        ensemble_columns=ENSEMBLE_COLUMNS,
        ensemble_rows=ensemble and ensemble_rows(ensemble),
        fastest=fastest_time(card),
        training=card["training"],
        constraints=_constraints(card),
        stress=_stress,
        ratio=_ratio,
        digits=lambda value: f"{value:.3g}",
        memory=lambda megabytes: "" if megabytes is None else f", {megabytes:.3g} MB",
        duration=lambda seconds: f"{seconds / 3600:.1f} hours" if seconds >= 3600 else f"{seconds / 60:.1f} minutes",
        pictures={name: text for name, text in PICTURES.items() if name in files},
        load=load or card["name"],
    )


def _error_rows(card: Mapping[str, Any], unit: Unit) -> Iterator[tuple[str, list[str]]]:
    """The rows of the table of errors: the model with its interval, the simulator, the trivial predictors."""
    test, ends = card["test"], card.get("interval") or {}
    names = [name for name in COLUMNS if name in test]

    def cells(figures: Mapping[str, float], prefix: str = "") -> list[str]:
        return [unit.show(figures[prefix + name], 3) if prefix + name in figures else "" for name in names]

    between = [f" ({unit.show(ends[n][0], 3)} – {unit.show(ends[n][1], 3)})" if n in ends else "" for n in names]
    yield "**the model**", [cell + text for cell, text in zip(cells(test), between, strict=True)]
    if twin := card.get("twin"):
        yield f"the simulator with {twin['substeps']} substeps a frame instead of {twin['own_substeps']}", cells(twin)
    if floor := card.get("floor"):
        yield "predictability limit", cells(floor)
    for kind, label in PREDICTORS.items():
        if kind != "model":
            yield label, cells(test, f"{kind}/")


def _quality(quality: Mapping[str, Any]) -> Iterator[str]:
    for name, (label, factor, unit) in QUALITY.items():
        if name in quality:
            mean, low, high = (factor * value for value in quality[name])
            yield f"{label} {mean:.3g} ({low:.3g} – {high:.3g}){unit}"


def _constraints(card: Mapping[str, Any]) -> list[str]:
    """What the constraints that act enforce."""
    acting = {name: value for name, value in card["constraints"].items() if value}
    if not card["obstacles"]:
        acting.pop("solids", None)
    return [CONSTRAINTS[name].format(value=value) for name, value in acting.items()]


def _stress(digest: Mapping[str, Any] | None) -> str:
    """The outcome of stress tests, such as `40 of 42 pass, quick (failed: 2 of "settling")`."""
    if digest is None:
        return "not run"
    groups = Counter(name.partition(":")[0] for name in digest["failed"])
    failed = ", ".join(f'{count} of "{group}"' for group, count in groups.items())
    total = digest["passed"] + len(digest["failed"])
    return f"{digest['passed']} of {total} pass, {digest['size']}{f' (failed: {failed})' if failed else ''}"


def index_page(root: Path, names: Sequence[str]) -> str:
    """The page of a zoo's models, as Markdown; entries with a damaged card are left out."""
    entries, cards = [], {}
    for name in names:
        try:
            card, recipe = read_card(root / name), read_recipe(read_yaml(root / name / CONFIG))
            with complete_card(name):
                entries.append(
                    (name, lifecycle(card), _figure_cells(card), _plain_times(card), _scene_cells(card, recipe))
                )
                cards[name] = card
        except (ZooError, DataError):
            continue
    return _TEMPLATES.get_template("index.md").render(
        entries=entries,
        hardware=sorted({name for _, _, _, times, _ in entries for name in times}),
        speed_ups=speed_tables(cards),
        factor=f"{FACTOR:g}",
        digits=lambda value: f"{value:.2g}",
    )


def _figure_cells(card: Mapping[str, Any]) -> list[str]:
    """Errors, and hours of training."""
    test, twin = card["test"], card.get("twin")
    low, high = (card.get("interval") or {}).get("mse", (None, None))
    between = "" if low is None else f" ({_thousandths(low)} – {_thousandths(high)})"
    simulator = "" if twin is None else _thousandths(twin["mse"])
    if twin is not None and abs(twin["substeps"] - twin["own_substeps"] / 2) > 0.5:
        simulator += f" ({twin['substeps']} of {twin['own_substeps']})"
    return [
        _thousandths(test.get("mse@100")),
        _thousandths(test["mse"]) + between,
        simulator,
        _thousandths(trivial_error(card)),
        f"{card['training']['seconds'] / 3600:.1f} h",
    ]


def _thousandths(value: float | None) -> str:
    return "" if value is None else Unit(-3).show(value, 3)


def _ratio(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _plain_times(card: Mapping[str, Any]) -> dict[str, float]:
    """Milliseconds per frame by hardware, of the model as `Zoo.load` gives it."""
    measured = (card.get("trade") or {}).get("times", [])
    plain = {time["hardware"]: time["ms_per_frame"] for time in measured if time["runtime"] == PLAIN}
    return {**stated_milliseconds(card), **plain}


def _scene_cells(card: Mapping[str, Any], recipe: EmulatorRecipe) -> list[str]:
    scene = recipe.scene
    known = "unknown" if scene.gravity is None else "(" + ", ".join(f"{value:.3g}" for value in scene.gravity) + ")"
    return [
        str(card.get("dataset", "")),
        ", ".join(scene.materials),
        " × ".join(f"{high - low:.3g}" for low, high in scene.bounds),
        str(card.get("particles", "")),
        f"{1e3 * scene.dt:.3g}",
        "any" if scene.gravity_varies else known,
        "yes" if scene.obstacles else "no",
        " × ".join(str(count) for count in recipe.grid.shape),
        str(recipe.frames),
    ]


def draw_chart(folder: Path, name: str) -> Figure | None:
    """The chart of `errors.csv` and `training.csv` in an entry's folder; None where it has neither."""
    errors, training = (_read_columns(folder / file) for file in ("errors.csv", "training.csv"))
    drawn = [columns for columns in (errors, training) if columns]
    if not drawn:
        return None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * len(drawn), 3.0), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = iter(figure.subplots(1, len(drawn), squeeze=False)[0])
    if errors:
        _draw_errors(next(axes), errors, name)
    if training:
        _draw_training(next(axes), training)
    return figure


def _draw_errors(axes: Axes, errors: Mapping[str, Sequence[float]], name: str) -> None:
    for kind, label in PREDICTORS.items():
        axes.plot(errors["frame"], [1e3 * value for value in errors[kind]], label=label)
    # Free fall is exact at first, by ten orders of magnitude more than what the curves are about.
    lowest = min((1e3 * value for value in errors["model"] if value > 0), default=None)
    axes.set(xlabel="frame", ylabel="squared error ×10⁻³", yscale="log", title=f"{name}: test scenes")
    axes.set_ylim(bottom=lowest and lowest / 2)
    axes.legend(frameon=False, fontsize="small")


def _draw_training(axes: Axes, training: Mapping[str, Sequence[float]]) -> None:
    values = [1e3 * value for value in training["mse"]]
    hours = [seconds / 3600 for seconds in training["seconds"]]
    # Restarts with a high learning rate raise the error for a while; what counts is the best so far.
    axes.plot(hours, values, ls="", marker=".", ms=3, color="0.7", label="each validation")
    axes.step(hours, list(accumulate(values, min)), where="post", label="best so far")
    axes.legend(frameon=False, fontsize="small")
    scale = "log" if max(values) > 10 * min(values) else "linear"
    axes.set(xlabel="hours of training", ylabel="validation MSE ×10⁻³", yscale=scale, title="full rollouts")


def _read_columns(path: Path) -> dict[str, list[float]]:
    """The columns of a table; empty where there is none."""
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    return {name: [float("nan" if row[name] == "" else row[name]) for row in rows] for name in rows[0]} if rows else {}
