"""From the best weights of a dataset's trainings to its entry in the zoo."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import torch

from nmpm._support.atomic import atomic_write
from nmpm._support.devices import join_hardware
from nmpm.data import catalog
from nmpm.data.folder_lock import lock_folder
from nmpm.data.simulation_request import SimulationRequest, same_trajectories
from nmpm.errors import DataError, ZooError
from nmpm.training.checkpoints import read_checkpoint
from nmpm.zoo.entries import CARD, load_entry, read_card
from nmpm.zoo.index import add_facts, refresh, write_index
from nmpm.zoo.measures.simulator import measure_twin
from nmpm.zoo.publish import replace, rounded_checkpoint, weights_of
from nmpm.zoo.queue.history import History
from nmpm.zoo.queue.plan import Dataset
from nmpm.zoo.queue.training import Training
from nmpm.zoo.queue.validations import GROUP, Curve, lowest_errors
from nmpm.zoo.registry import Zoo
from nmpm.zoo.runs import BEST

MERGED = "merged.json"
"""The report of the test with what all trainings took."""
Command = Callable[[list[str]], int]
"""Runs `nmpm` with these words and returns its exit status."""


def collect(history: History, zoo: Path, run: Command) -> str:
    """Test a dataset's best weights and make its entry of them, also while its training goes on.

    An entry that has these weights already keeps all that its card states; only goal and curve are written to it.
    An entry whose validation error is lower is kept, so that the test split chooses nothing; so is one that has more
    validations than a training whose few may be low by chance. Only for an entry whose card has no validation errors,
    from before the queue, those of the test are compared. In all cases the card then states what the last round of
    training gained, so that the queue knows it without the trainings too.

    Args:
        history: Of the dataset.
        zoo: Folder of the zoo to write to.
        run: Runs the test.

    Returns:
        What was done, in words.

    Raises:
        ZooError: if the test fails.
    """
    entry, folder = zoo / history.dataset.name, history.folder / "collected"
    with lock_folder(folder):
        best = history.best()
        if best is None:
            return f"{history.dataset.name}: nothing is validated yet."
        said = _collect_best(history, best, entry, zoo, run)
        _state_last_round(history, best, entry)
        write_index(zoo)
    return said


def _collect_best(history: History, best: Training, entry: Path, zoo: Path, run: Command) -> str:
    """Make the entry of these weights, or leave it; what was done, in words."""
    name, folder = history.dataset.name, history.folder / "collected"
    former = _card(entry)
    if former and former.get("sha256") == weights_of(best.best):
        _update(entry, former, history)
        return f"{name}: its best weights are already in {entry}."
    report = _merged(_tested(best, folder, run), history)
    for file in (MERGED, "report.json"):
        with atomic_write(folder / file) as part:
            part.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    error = report["test"]["mse"]
    if (reason := _reason_to_keep(name, zoo, best.curve(), error)) is not None:
        return f"{name}: the entry is kept, as {reason}."
    former, recipe = _card(entry), _recipe_text(entry)  # again, as the test takes minutes
    dataset = history.dataset_of(history.trainings.index(best) + 1)
    replace(folder, name, zoo, dataset.about or describe_data(history.dataset, dataset))
    card = read_card(entry)
    same_work = recipe == _recipe_text(entry) and former.get("particles") == card.get("particles")
    if same_work and former.get("speed"):  # of other hardware too, and not measured beside other trainings
        add_facts(entry, str(card["sha256"]), {"speed": former["speed"]})
    else:
        refresh(entry, ["speed"])
    known = simulator_facts(former, card)
    add_facts(entry, str(card["sha256"]), _references(entry, history, dataset, known))
    return f"{name}: {1e3 * error:.4g} ×10⁻³ on the test split, now in {entry}."


def _state_last_round(history: History, best: Training, entry: Path) -> None:
    """Write to the entry's card what the last round of training gained, where the entry has the best weights so far."""
    card, gain, start = _card(entry), history.last_gain(), history.starting_entry
    own = {weights_of(best.best), *([] if start is None else [start.weights()])}
    if gain is None or not math.isfinite(gain) or card.get("sha256") not in own:
        return
    facts = {"last_round": {"hours": round(history.trainings[-1].seconds() / 3600, 2), "gain": round(gain, 4)}}
    if card.get("last_round") != facts["last_round"]:
        add_facts(entry, str(card["sha256"]), facts)


def _card(entry: Path) -> dict[str, Any]:
    """The card of an entry; empty where there is none."""
    return read_card(entry) if (entry / CARD).is_file() else {}


def _recipe_text(entry: Path) -> str:
    """The text of an entry's config.yaml, its model's recipe; empty where there is no entry."""
    path = entry / "config.yaml"
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _update(entry: Path, card: Mapping[str, Any], history: History) -> None:
    """Write the goal and the curve so far to the card of an entry with the best weights, where it states others."""
    goal = history.dataset.goal
    facts = {"curve": history.curve(), **({} if goal is None else {"goal": goal})}
    if any(card.get(key) != value for key, value in facts.items()):
        add_facts(entry, str(card["sha256"]), facts)


def _tested(best: Training, folder: Path, run: Command) -> dict[str, Any]:
    """The report of a test of the best weights, rounded as in their entry, in a folder; the former one of the same."""
    copy, merged = folder / BEST, folder / MERGED
    content = rounded_checkpoint(best.best)
    if merged.is_file() and _digest(copy) == content["nmpm_digest"]:
        report = _read(merged)
        if "particles" in report:  # else of an earlier version
            return report
    merged.unlink(missing_ok=True)
    with atomic_write(copy) as part:
        torch.save(content, part)
    if run(best.test_command(folder)):
        raise ZooError(f"The test of {copy} failed.")
    return _read(folder / "report.json")


def _digest(checkpoint: Path) -> str | None:
    """That of a checkpoint's weights; None where it is missing, damaged or states none."""
    try:
        return cast("str | None", read_checkpoint(checkpoint).get("nmpm_digest"))
    except DataError:
        return None


def simulator_facts(former: Mapping[str, Any], card: Mapping[str, Any]) -> dict[str, Any]:
    """How uncertain the simulator itself is, from the card of a former model with the same simulated test scenes."""
    before, now = former.get("simulation", {}), card.get("simulation", {})
    as_many = before.get("counts", {}).get("test") == now.get("counts", {}).get("test")
    same = bool(now) and as_many and same_trajectories(before, now)
    return {key: former[key] for key in ("twin", "floor") if same and key in former}


def _references(entry: Path, history: History, dataset: Dataset, known: Mapping[str, Any]) -> dict[str, Any]:
    """What a card states beside the errors of the model: the goal, and how uncertain the simulator itself is.

    Args:
        entry: Its folder.
        history: Of the dataset.
        dataset: With the values of the training whose weights these are.
        known: From `simulator_facts`.
    """
    goal = {} if dataset.goal is None else {"goal": dataset.goal}
    if "twin" in known or dataset.generation() is None:  # the former card states it, or the data are recorded
        return {**known, **goal}
    kept = history.folder / "twin.json"
    if not kept.is_file():  # measured once, as it does not depend on the model
        data = catalog.dataset_folder(*_request(dataset))
        twin = measure_twin(load_entry(entry), data if (data / "test.h5").is_file() else None)
        with atomic_write(kept) as part:
            part.write_text(json.dumps(twin.to_dict(), indent=1), encoding="utf-8")
    return {**known, **goal, "twin": _read(kept)}


def _request(dataset: Dataset) -> tuple[str, SimulationRequest]:
    """Name and request of simulated data."""
    name, options = dataset.generation() or ("", {})
    return name, catalog.simulation_request(name, **{key: options[key] for key in options if key != "workers"})


def _merged(report: dict[str, Any], history: History) -> dict[str, Any]:
    """The report of a test with the time, steps and curve of all trainings before it."""
    stages = history.stages
    best = history.best() or history.trainings[-1]
    until = stages[: stages.index(best) + 1]
    training = report["training"] | {
        "steps": sum(stage.steps() for stage in until),
        "seconds": round(sum(stage.seconds() for stage in until), 1),
        "precision": best.precision(),
        "hardware": join_hardware(*(stage.hardware() for stage in until)) or report["training"]["hardware"],
    }
    return report | {"training": training, "curve": history.curve()}


def describe_data(first: Dataset, last: Dataset) -> str:
    """How the data of the first and of the last training were simulated; empty for recorded data."""
    if last.generation() is None:
        return ""
    _, request = _request(last)
    counts, preset = request.counts, request.preset
    at_first = _request(first)[1].counts["train"]
    more = "" if at_first == counts["train"] else f", {at_first} of them in the first hours"
    return (
        f"{counts['train']} trajectories to train on{more}, {counts['valid']} to validate and {counts['test']} to test,"
        f" of {preset.frames + 1} frames, from nmpm's own {preset.generator}, seed {request.seed}; figures on others'"
        " data of that name are not comparable."
    )


def _reason_to_keep(name: str, zoo: Path, validations: Curve, test: float) -> str | None:
    """Why the published entry is better than weights with these errors; None if it is not, or there is none."""
    try:
        card = Zoo.card(name, zoo)
        split, (published, found) = "validation", lowest_errors(card.get("curve", []), validations)
        if not card.get("curve"):
            split, found, published = "test", test, float(card["test"]["mse"])
    except (ZooError, KeyError, TypeError, ValueError, IndexError):
        return None
    if published >= found:
        return None
    if not math.isfinite(found):
        return f"the training has too few validations to be compared, {len(validations)} of {GROUP}"
    return f"its {split} error {1e3 * published:.4g} ×10⁻³ is below {1e3 * found:.4g}"


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content
