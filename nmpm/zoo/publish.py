"""Make a zoo entry of a finished run: recipe, weights, and a card of the run's own measurements."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nmpm._support.atomic import atomic_folder
from nmpm._support.bounded_files import check_characters, to_yaml
from nmpm._support.digests import float32_digest
from nmpm._support.shipped import PACKAGE, shipped_folder, user_zoo
from nmpm.emulator import Emulator
from nmpm.errors import DataError, ZooError
from nmpm.training.checkpoints import load_module, read_checkpoint
from nmpm.zoo.cards import readme, stress_digest
from nmpm.zoo.charts import write_chart
from nmpm.zoo.entries import CARD, writing
from nmpm.zoo.golden import golden_rollout
from nmpm.zoo.index import write_index
from nmpm.zoo.lifecycle import CARD_FORMAT, lifecycle
from nmpm.zoo.registry import check_name
from nmpm.zoo.runs import BEST
from nmpm.zoo.storage import round_network, serialise, stored_precision

STRESS_REPORTS = {"stress": "stress.json", "stress_free": "stress_free.json"}
"""Files of `nmpm stress --report`, with and without constraints, by the key of the card."""
COPIED = ("rollout.png", "errors.csv")
"""Files of a run that its entry keeps."""


def add(run: Path, name: str, root: str | Path | None = None, about: str = "") -> Path:
    """Turn a run's best checkpoint and report into the zoo entry `root/name`.

    Args:
        run: The run's folder, as `nmpm fit` left it. If it holds `stress.json` or `stress_free.json`, from
            `nmpm stress --report` with and without constraints, the card states their outcome.
        name: Name of the new model.
        root: The zoo's folder; the user's own zoo when left out.
        about: Description of the data and their origin, for the card.

    Returns:
        The entry's folder, which is written completely or not at all.

    Raises:
        ZooError: if the run is not finished, a report cannot be read, the name is taken, or the folder cannot be
            written or is part of the installed package.
    """
    target = new_entry_folder(name, root)
    _publish(run, name, target, about)
    write_index(user_zoo() if root is None else Path(root))
    return target


def _digest(checkpoint: Path) -> str:
    """That of a checkpoint's weights, as reports of its test state it."""
    return float32_digest(read_checkpoint(checkpoint)["state_dict"])


def _rounded(checkpoint: Path) -> Emulator:
    """The emulator of a checkpoint as its entry stores it."""
    return round_network(load_module(checkpoint).emulator.eval().requires_grad_(False))


def _publish(run: Path, name: str, target: Path, about: str) -> None:
    checkpoint, report = run / BEST, run / "report.json"
    for needed in (checkpoint, report):
        if not needed.is_file():
            raise ZooError(f"{run} is not a finished run: {needed} is missing. Let `nmpm fit` end with its test.")
    figures = _read_json(report)
    if figures.get("weights", digest := _digest(checkpoint)) != digest:
        raise ZooError(f"{report} is of other weights than {checkpoint}: test these by `nmpm test {run}`.")
    emulator = _rounded(checkpoint)
    weights = serialise(emulator)
    files = [path for path in (run / file for file in COPIED) if path.is_file()]
    try:
        card = _card(name, about, figures, emulator) | {"sha256": hashlib.sha256(weights).hexdigest()}
        present = {key: run / file for key, file in STRESS_REPORTS.items() if (run / file).is_file()}
        card |= {key: stress_digest(_read_json(path)) for key, path in present.items()}
        check_characters(card, target / CARD)
        texts = {
            "config.yaml": to_yaml(emulator.recipe.to_dict()),
            CARD: to_yaml(card),
            "README.md": readme(card, [file.name for file in files]),
        }
    except DataError as error:
        raise ZooError(str(error)) from error
    except (KeyError, TypeError) as error:
        raise ZooError(f"A report in {run} lacks {error}: write it again by `nmpm test` or `nmpm stress`.") from error
    try:
        with writing(target):
            _write(target, weights, texts, files)
    except OSError as error:
        raise ZooError(f"{target} cannot be written: {error.strerror or error}.") from error


def new_entry_folder(name: str, root: str | Path | None) -> Path:
    """The folder of a new entry, of the user's own zoo where `root` is None.

    Raises:
        ZooError: if the name is malformed or taken, also by a shipped model, which the new one would hide; or if the
            folder is part of the installed package.
    """
    check_name(name)
    zoo = _writable_zoo(user_zoo() if root is None else Path(root))
    taken = [zoo / name, *([shipped_folder("zoo") / name] if root is None else [])]
    for folder in taken:
        if (folder / "card.yaml").exists():
            raise ZooError(f"{folder} exists: choose another name, or remove it first.")
    return zoo / name


def _writable_zoo(zoo: Path) -> Path:
    """The folder of a zoo.

    Raises:
        ZooError: if it is part of the installed package.
    """
    if zoo.resolve().is_relative_to(PACKAGE.resolve()):
        raise ZooError(f"{zoo} is part of the installed package: leave --root out to add to {user_zoo()}.")
    return zoo


def _write(target: Path, weights: bytes, texts: Mapping[str, str], files: Sequence[Path]) -> None:
    """Write an entry's folder, in place of a former one; variants, which lie within it, stay."""
    with atomic_folder(target) as new:
        (new / "model.safetensors").write_bytes(weights)
        for name, text in texts.items():
            (new / name).write_text(text, encoding="utf-8")
        for file in files:
            shutil.copyfile(file, new / file.name)
        write_chart(new)
        for card in target.glob(f"*/{CARD}"):
            shutil.copytree(card.parent, new / card.parent.name)


def _card(name: str, about: str, figures: Mapping[str, Any], emulator: Emulator) -> dict[str, Any]:
    card = {
        "format": CARD_FORMAT,
        "name": name,
        "lifecycle": "",
        "dataset": figures["dataset"],
        "about": about,
        "license": "MIT",
        "test": figures["test"],
        "per_trajectory": figures["per_trajectory"]["model"],
        "training": figures["training"],
        **{key: figures[key] for key in ("curve", "simulation", "particles") if figures.get(key)},
        "constraints": dataclasses.asdict(emulator.constraints),
        "obstacles": emulator.scene.obstacles,
        "versions": figures["versions"],
        "weights": stored_precision(emulator),
        "golden": golden_rollout(emulator),
    }
    return card | {"lifecycle": lifecycle(card)}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise ZooError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise ZooError(f"{path} should hold keys and values.")
    return content
