"""From the best weights of a dataset's trainings to its entry in the zoo."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch

from nmpm._support.atomic import atomic_write
from nmpm._support.devices import join_hardware
from nmpm.data import catalog
from nmpm.data.folder_lock import lock_folder
from nmpm.data.simulation_request import SimulationRequest, same_test_scenes
from nmpm.errors import DataError, UnstableError, ZooError
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
DONE = "collected.txt"
"""How many of the trainings have been collected that had ended."""
INTERRUPTED = 130
"""Exit status of `nmpm` after an interruption."""
Command = Callable[[list[str]], int]
"""Runs `nmpm` with these words and returns its exit status."""


def collect(history: History, zoo: Path, run: Command) -> str:
    """Test a dataset's best weights and make its entry of them, also while its training goes on.

    An entry that has these weights already keeps all that its card states; goal and curve are brought up to date, times
    and the twin measured where it lacks them. An entry whose validation error is lower is kept, so that the test split
    chooses nothing; so is one that has more validations than a training whose few may be low by chance. Only for an
    entry whose card has no validation errors, from before the queue, those of the test are compared. In all cases the
    card then states what the last round of training gained, so that the queue knows it without the trainings too.

    Args:
        history: Of the dataset.
        zoo: Folder of the zoo to write to.
        run: Runs the test.

    Returns:
        What was done, in words.

    Raises:
        ZooError: if the test fails.
        KeyboardInterrupt: if the test is interrupted.
    """
    entry, folder = zoo / history.dataset.name, history.folder / "collected"
    with lock_folder(folder):
        ended, best = _ended(history), history.best()
        if best is None:
            return f"{history.dataset.name}: nothing is validated yet."
        weights = weights_of(best.best)
        said = _collect_best(history, best, weights, zoo, run)
        _state_last_round(history, weights, entry)
        write_index(zoo)
        with atomic_write(folder / DONE) as part:
            part.write_text(f"{ended}\n", encoding="utf-8")
    return said


def _collect_best(history: History, best: Training, weights: str, zoo: Path, run: Command) -> str:
    """Make the entry of the best training's weights, of this SHA-256, or leave it; what was done, in words."""
    name, folder = history.dataset.name, history.folder / "collected"
    entry = zoo / name
    dataset = history.dataset_of(history.trainings.index(best) + 1)
    if _card(entry).get("sha256") == weights:
        _complete(entry, history, dataset)
        return f"{name}: its best weights are already in {entry}."
    report = _merged(_tested(best, folder, run), history)
    for file in (MERGED, "report.json"):
        with atomic_write(folder / file) as part:
            part.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    error = report["test"]["mse"]
    if (reason := _reason_to_keep(name, zoo, best.curve(), error)) is not None:
        return f"{name}: the entry is kept, as {reason}."
    about = dataset.about or describe_data(history.dataset, dataset)
    replace(folder, name, zoo, about, partial(kept_facts, entry))
    _complete(entry, history, dataset)
    return f"{name}: {1e3 * error:.4g} ×10⁻³ on the test split, now in {entry}."


def is_collected(history: History) -> bool:
    """Whether all trainings that have ended are collected: not so if a process died or failed in a collection."""
    done, merged = (history.folder / "collected" / name for name in (DONE, MERGED))
    if done.is_file():
        return done.read_text(encoding="utf-8").strip() == str(_ended(history))
    report = history.trainings[-1].folder / "report.json"  # by an earlier version, which left no such file
    return merged.is_file() and report.is_file() and merged.stat().st_mtime >= report.stat().st_mtime


def _ended(history: History) -> int:
    """Number of trainings that have ended."""
    return sum(training.finished for training in history.trainings)


def _state_last_round(history: History, weights: str, entry: Path) -> None:
    """Write to the entry's card what the last round of training gained, where it is this dataset's.

    That is, where its weights are the best of the trainings, of this SHA-256, or those that the first one started from.
    """
    card, gain, start = _card(entry), history.last_gain(), history.starting_entry
    own = {weights} if start is None else {weights, start.weights()}
    if gain is None or not math.isfinite(gain) or card.get("sha256") not in own:
        return
    last = history.trainings[-1]
    stated = {"hours": round(last.seconds() / 3600, 2), "gain": round(gain, 4), "options": last.recipe()}
    if card.get("last_round") != stated:
        add_facts(entry, str(card["sha256"]), {"last_round": stated})


def _card(entry: Path) -> dict[str, Any]:
    """The card of an entry; empty where there is none."""
    return read_card(entry) if (entry / CARD).is_file() else {}


def _recipe_text(entry: Path) -> str:
    """The text of an entry's config.yaml, its model's recipe; empty where there is no entry."""
    path = entry / "config.yaml"
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def kept_facts(entry: Path, card: Mapping[str, Any], recipe: str) -> dict[str, Any]:
    """What a new card takes over from that of an entry: the simulator's uncertainty, and times of the same network.

    Times are of other hardware too, and were not measured beside other trainings.

    Args:
        entry: Folder of the former entry.
        card: The new card.
        recipe: The text of its config.yaml.
    """
    former = _card(entry)
    same_work = recipe == _recipe_text(entry) and former.get("particles") == card.get("particles")
    times = {"speed": former["speed"]} if same_work and former.get("speed") else {}
    return {**times, **simulator_facts(former, card)}


def _complete(entry: Path, history: History, dataset: Dataset) -> None:
    """Bring goal and curve of a card up to date, and measure times and the twin if it lacks them."""
    card = read_card(entry)
    weights = str(card["sha256"])
    facts = {"curve": history.curve(), **({} if dataset.goal is None else {"goal": dataset.goal})}
    if json.dumps([card.get(key) for key in facts]) != json.dumps(list(facts.values())):  # NaN equals NaN there
        add_facts(entry, weights, facts)
    if not card.get("speed"):
        refresh(entry, ["speed"])
    simulated = dataset.generation() is not None and card.get("simulation")
    if simulated and "twin" not in card and (twin := _twin(entry, history, dataset)):
        add_facts(entry, weights, {"twin": twin})


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
    status = run(best.test_command(folder))
    if status == INTERRUPTED:
        raise KeyboardInterrupt
    if status:
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
    before, now = former.get("simulation") or {}, card.get("simulation") or {}
    same = bool(now) and same_test_scenes(before, now)
    return {key: former[key] for key in ("twin", "floor") if same and key in former}


def _twin(entry: Path, history: History, dataset: Dataset) -> dict[str, Any] | None:
    """Errors of the simulator's twin, measured once for the same test scenes; None where it is unstable.

    They do not depend on the model, so that they are kept beside the trainings.
    """
    kept, stated = history.folder / "twin.json", read_card(entry)["simulation"]
    scenes = {key: stated.get(key) for key in ("preset", "seed", "revision")} | {"test": stated["counts"]["test"]}
    found = _read(kept) if kept.is_file() else {}
    if found.get("scenes") != scenes:
        name, request = _request(dataset)
        data = catalog.dataset_folder(name, request)
        same = same_test_scenes(stated, json.loads(json.dumps(request.to_dict()))) and (data / "test.h5").is_file()
        try:
            twin = measure_twin(load_entry(entry), data if same else None).to_dict()
        except UnstableError:
            twin = None
        found = {"scenes": scenes, "twin": twin}
        with atomic_write(kept) as part:
            part.write_text(json.dumps(found, indent=1), encoding="utf-8")
    return cast("dict[str, Any] | None", found["twin"])


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
