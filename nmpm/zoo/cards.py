"""The text of a card: errors beside the trivial predictors, training, constraints and stress tests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from nmpm.evaluation.bootstrap import interval
from nmpm.evaluation.figures import PREDICTORS, Unit, figure_names, figures_unit, predictor_figures
from nmpm.zoo.lifecycle import FACTOR, lifecycle

CONSTRAINTS = {
    "energy": "energy (kinetic plus potential energy never exceeds that of the first state)",
    "rest_speed": "rest_speed = {value:g} cells per frame (slower particles on firm ground stay where they are)",
    "solids": "solids (no particle enters an obstacle)",
    "density_cap": "density_cap = {value:g} (cells with a larger volume fraction spread)",
    "bounds": "bounds = {value} (no particle leaves the scene's bounds)",
}
"""What each constraint enforces, by its key in `card.yaml`."""
MALFORMED = (KeyError, TypeError, ValueError, AttributeError, IndexError)
"""What `readme` and charts raise where a card or a table lacks something, or has other kinds of values."""
PICTURES = {
    "chart.png": "errors over frames and over training",
    "rollout.png": "rollout",
    "worst.png": "the test scene with the largest error",
}
"""What an entry's pictures show, by their names."""
SOURCE = (
    "O. Rochman-Sharabi, S. Lewin, G. Louppe, *A Neural Material Point Method for Particle-based Emulation*, TMLR 2025,"
    " arXiv 2408.15753"
)
"""The paper of the method."""
NAMED = 4
"""Failed stress tests that a README names; more are counted by group."""


def stress_digest(report: Mapping[str, Any]) -> dict[str, Any]:
    """A summary of a report of `nmpm stress`: its size, how many lines passed, and which failed."""
    lines = report["lines"]
    return {
        "size": report["size"],
        "passed": sum(line["passed"] is True for line in lines),
        "failed": [f"{line['group']}: {line['name']}" for line in lines if line["passed"] is False],
    }


def stress_line(card: Mapping[str, Any]) -> str:
    """Stress tests with constraints ("held") and without ("free"), e.g. "held: 41 of 42; free: 30 of 42"."""
    kinds = {"held": card.get("stress"), "free": card.get("stress_free")}
    return "; ".join(f"{kind}: {_stress_outcome(digest)}" for kind, digest in kinds.items())


def readme(card: Mapping[str, Any], files: Collection[str] = (), load: str | None = None) -> str:
    """The README of an entry, as Markdown.

    Args:
        card: The content of `card.yaml`.
        files: Names of the files of the entry; pictures among them are shown.
        load: What `Zoo.load` takes; the model's name when left out.
    """
    training, test = card["training"], card["test"]
    names, unit = figure_names(test), figures_unit(test)
    emd = ", exact earth mover's distance (`emd`) in domain length" if "emd" in names else ""
    lines = [
        f"# {card['name']}",
        "",
        f"An emulator of {card['dataset']}. {card.get('about', '')}".rstrip(),
        "",
        *_lifecycle_lines(card),
        f"Test error{unit} of one run, over {_trajectories(card)}, from full rollouts: MSE over frames 1 … h in domain"
        f" length² (`mse`: over all frames){emd}.",
        "",
        f"| predictor | {' | '.join(names)} |",
        f"|---|{'---:|' * len(names)}",
        *(f"| {label} | {' | '.join(_errors(test, kind, unit))} |" for kind, label in PREDICTORS.items()),
        *_interval_row(card, names, unit),
        "",
        *_goal_lines(card),
        *_twin_lines(card),
        *_floor_lines(card),
        *_quality_lines(card),
        *_failure_lines(card),
        *_speed_lines(card),
        f"Trained for {training['steps']} steps in {training['seconds'] / 60:.1f} minutes on {training['hardware']}, "
        f"{training['precision']}; {training['parameters']:,} parameters{_storage(card)}; one run.{_last_round(card)}",
        "",
        *_constraint_lines(card),
        f"`nmpm stress`: {stress_line(card)}. `held` is with these constraints, `free` with the bounds alone.",
        "",
        "```python",
        "from nmpm import Zoo",
        "",
        f'model = Zoo.load("{load or card["name"]}")',
        "positions = model.rollout(model.example(), frames=400)  # (1, 400, N, D)",
        "```",
    ]
    lines += [line for name, text in PICTURES.items() if name in files for line in ("", f"![{text}]({name})")]
    lines += ["", *_licence_lines(card)]
    return "\n".join(lines) + "\n"


def intervals(card: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """The 95% interval of each figure's mean over test scenes, for those that every scene has; empty for one scene."""
    rows = card.get("per_trajectory") or []
    names = [name for name in (rows[0] if len(rows) > 1 else ()) if all(name in row for row in rows)]
    return {name: interval([row[name] for row in rows]) for name in names}


def twin_ratio(card: Mapping[str, Any], name: str) -> str:
    """A figure of the model over the simulator's own uncertainty, to 2 digits; empty where that is not measured."""
    twin, test = card.get("twin") or {}, card.get("test") or {}
    known = name in twin and name in test and twin[name] > 0
    return f"{test[name] / twin[name]:.2g}" if known else ""


def _twin_lines(card: Mapping[str, Any]) -> list[str]:
    twin = card.get("twin")
    if not twin:
        return []
    names = [name for name in ("mse@100", "mse") if name in twin]
    figures = ", ".join(f"`{n}` {1e3 * twin[n]:.3g} ×10⁻³ (the model: {twin_ratio(card, n)} times that)" for n in names)
    return [
        f"The simulator with {twin['substeps']} substeps a frame beside itself with {twin['own_substeps']}: {figures}.",
        "",
    ]


def _last_round(card: Mapping[str, Any]) -> str:
    """What the last round of training gained, which may have left the weights as they were."""
    if not (stated := card.get("last_round")):
        return ""
    hours, gain = f"{stated['hours']:.1f} h", stated["gain"]
    if gain <= 0:
        return f" A further round of training, of {hours}, did not lower its validation error."
    return f" The last round of training, of {hours}, lowered its validation error by {100 * gain:.2g}%."


def _failure_lines(card: Mapping[str, Any]) -> list[str]:
    """Failures that a person saw in the pictures."""
    return [f"Known failures: {card['failures']}", ""] if card.get("failures") else []


def _goal_lines(card: Mapping[str, Any]) -> list[str]:
    """The goal for the full-rollout error, and whether it is reached."""
    goal = card.get("goal")
    if goal is None:
        return []
    reached = "reached" if card["test"]["mse"] <= goal else f"missed by a factor of {card['test']['mse'] / goal:.2g}"
    return [f"Goal for `mse`: {1e3 * goal:.3g} ×10⁻³, {reached}.", ""]


def _floor_lines(card: Mapping[str, Any]) -> list[str]:
    floor = card.get("floor")
    if not floor:
        return []
    figures = ", ".join(f"`{name}` {1e3 * floor[name]:.2g} ×10⁻³" for name in ("mse@100", "mse") if name in floor)
    unstable = floor.get("unstable")
    left_out = f" Left out as the nudge makes them unstable: test scenes {unstable}." if unstable else ""
    return [
        f"Predictability: the simulator beside itself, started from positions that differ by {floor['nudge']:g} of the"
        f" domain's side: {figures}.{left_out}",
        "",
    ]


def _quality_lines(card: Mapping[str, Any]) -> list[str]:
    quality = card.get("quality")
    if not quality:
        return []
    forms = {
        "emd": ("earth mover's distance", 1e3, " ×10⁻³"),
        "kinetic": ("kinetic energy off by", 100, "%"),
        "height": ("height of the last frame's material off by", 100, "%"),
        "crowding": ("particles per occupied cell off by", 100, "%"),
    }
    known = [(quality[name], *form) for name, form in forms.items() if name in quality]
    texts = [f"{text} {_range(figure, factor)}{unit}" for figure, text, factor, unit in known]
    worst = quality["worst"]
    return [
        f"On the test scenes, mean and its 95% interval: {'; '.join(texts)}. Of rollouts of one scene"
        " at a time, whose rounding differs from that of the table's batches, the largest error is that of scene"
        f" {worst['scene']}, {1e3 * worst['mse']:.3g} ×10⁻³.",
        "",
    ]


def _range(figure: Mapping[str, Any], factor: float) -> str:
    mean, between = f"{factor * figure['mean']:.3g}", figure.get("interval")
    return f"{mean} ({factor * between[0]:.3g} – {factor * between[1]:.3g})" if between else mean


def _speed_lines(card: Mapping[str, Any]) -> list[str]:
    lines = [
        f"{entry['hardware']}: {entry['ms_per_frame']:.3g} ms per frame{_memory(entry, 'memory_mb')} of one scene of"
        f" {entry['particles']} particles, {entry['best_ms_per_frame']:.3g} ms{_memory(entry, 'best_memory_mb')} in"
        f" batches of {entry['best_batch']}."
        for entry in card.get("speed") or ()
    ]
    return [line for text in lines for line in (text, "")]


def _storage(card: Mapping[str, Any]) -> str:
    """What the weights are stored in, where a card says so."""
    return f", stored in {card['weights']}" if card.get("weights") else ""


def _memory(entry: Mapping[str, Any], name: str) -> str:
    """Peak memory beside a time, empty where it is not known."""
    return f" and {entry[name]:.3g} MB" if entry.get(name) is not None else ""


def _lifecycle_lines(card: Mapping[str, Any]) -> list[str]:
    """Why a model is a preview or superseded."""
    texts = {
        "preview": f"**Preview**: its full-rollout error is not {FACTOR:g} times lower than a trivial predictor's.",
        "superseded": f"**Superseded** by `{card.get('superseded_by')}`.",
    }
    state = lifecycle(card)
    return [texts[state], ""] if state in texts else []


def _licence_lines(card: Mapping[str, Any]) -> list[str]:
    """The licence, and how to cite the model: the method by its paper, the weights by their hash."""
    licence = f"Licence: {card['license']}. " if card.get("license") else ""
    weights = f", SHA-256 of its weights {card['sha256'][:12]}…" if card.get("sha256") else ""
    return [f"{licence}To cite it: `nmpm`'s model `{card['name']}`{weights}; the method: {SOURCE}."]


def _interval_row(card: Mapping[str, Any], names: list[str], unit: Unit) -> list[str]:
    found = intervals(card)
    cells = [" – ".join(unit.show(end, 3) for end in found.get(name, ())) for name in names]
    return [f"| model, 95% over scenes | {' | '.join(cells)} |"] if found else []


def _errors(test: Mapping[str, float], kind: str, unit: Unit) -> Iterator[str]:
    """A predictor's errors to 3 significant digits, in the order of `figure_names`."""
    for value in predictor_figures(test, kind):
        yield "" if value is None else unit.show(value, 3)


def _trajectories(card: Mapping[str, Any]) -> str:
    count = len(card.get("per_trajectory") or ())
    return "1 trajectory" if count == 1 else f"{count} trajectories" if count else "the test split"


def _constraint_lines(card: Mapping[str, Any]) -> list[str]:
    """What the constraints that act enforce; none for cards of version 0.1, which do not state them."""
    if "constraints" not in card:
        return []
    acting = dict(card["constraints"])
    if not card.get("obstacles"):
        acting.pop("solids", None)
    stated = [CONSTRAINTS[name].format(value=value) for name, value in acting.items() if value and name in CONSTRAINTS]
    return [f"Rollouts are constrained by {'; '.join(stated)}.", ""]


def _stress_outcome(digest: Mapping[str, Any] | None) -> str:
    if digest is None:
        return "not run"
    failed = digest["failed"]
    groups = Counter(name.partition(":")[0] for name in failed)
    counted = [f"{count} of {group}" for group, count in groups.items()]
    names = f" (failed: {'; '.join(failed if len(failed) <= NAMED else counted)})" if failed else ""
    return f"{digest['passed']} of {digest['passed'] + len(failed)} lines passed, {digest['size']}{names}"
