"""Make a zoo entry of a finished run: recipe, weights, and a card of the run's own measurements."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from nmpm._support.atomic import atomic_folder
from nmpm._support.bounded_files import to_yaml
from nmpm._support.shipped import PACKAGE, shipped_folder, user_zoo
from nmpm.data.simulation import in_short
from nmpm.emulator import Emulator
from nmpm.emulator.adaptation import adapted
from nmpm.emulator.digests import float32_digest
from nmpm.errors import ZooError
from nmpm.training.checkpoints import read_checkpoint
from nmpm.training.module import load_module
from nmpm.zoo.card import BEST, CARD, CONFIG, FORMAT, SCENES, WEIGHTS, intervals, stress_digest
from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.refresh import write_card, write_index, writing
from nmpm.zoo.registry import check_name
from nmpm.zoo.verification import golden_distance, golden_rollout

STRESS_REPORTS = ("stress", "stress_free")
"""Keys of the card, and with .json files of `nmpm stress --report`, with and without constraints."""
COPIED = ("rollout.png", "errors.csv")
"""Files of a run that its entry keeps."""
NOTICED = 0.02
"""Distance in cells: float16 is used if it moves no probe of the golden rollout by as much. The zoo's models move by
0.0001 to 0.01, and their errors at 8, 32 and 100 frames change by less than 2%."""
_NETWORK = "processor."


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
    checkpoint, report = run / BEST, run / "report.json"
    for needed in (checkpoint, report):
        if not needed.is_file():
            raise ZooError(f"{run} is not a finished run: {needed} is missing. Let `nmpm fit` end with its test.")
    figures = _read_json(report)
    digest = float32_digest(read_checkpoint(checkpoint)["state_dict"])
    if figures.get("weights", digest) != digest:
        raise ZooError(f"{report} is of other weights than {checkpoint}: test these by `nmpm test {run}`.")
    trained = load_module(checkpoint).emulator.eval().requires_grad_(False)
    emulator = round_network(trained)
    precision = torch.float32 if emulator is trained else torch.float16
    weights = serialise(emulator, precision)
    stress = {key: _read_json(run / f"{key}.json") for key in STRESS_REPORTS if (run / f"{key}.json").is_file()}
    try:
        rows = figures["per_trajectory"]["model"]
        card = _card(name, about, figures, rows, emulator)
        card |= {"weights": str(precision).removeprefix("torch."), "sha256": hashlib.sha256(weights).hexdigest()}
        card |= {key: stress_digest(content["size"], content["lines"]) for key, content in stress.items()}
    except (KeyError, TypeError) as error:
        raise ZooError(f"A report in {run} lacks {error}: write it again by `nmpm test` or `nmpm stress`.") from error
    names = list(dict.fromkeys(name for row in rows for name in row))
    tables = {SCENES: table_text(names, ([row.get(name, "") for name in names] for row in rows))}
    if figures.get("curve"):
        columns = ("seconds", "steps", "mse", "overall")[: len(figures["curve"][-1])]
        tables["training.csv"] = table_text(columns, figures["curve"])
    zoo = user_zoo() if root is None else Path(root)
    try:
        with writing(), atomic_folder(target) as new:
            (new / WEIGHTS).write_bytes(weights)
            for file, text in {CONFIG: to_yaml(emulator.recipe.to_dict()), **tables}.items():
                (new / file).write_text(text, encoding="utf-8")
            for file in COPIED:
                if (run / file).is_file():
                    shutil.copyfile(run / file, new / file)
            write_card(new, card)
            for variant in target.glob(f"*/{CARD}"):  # they lie within it
                shutil.copytree(variant.parent, new / variant.parent.name)
        write_index(zoo)
    except OSError as error:
        raise ZooError(f"{target} cannot be written: {error.strerror or error}.") from error
    return target


def new_entry_folder(name: str, root: str | Path | None) -> Path:
    """The folder of a new entry, of the user's own zoo where `root` is None.

    Raises:
        ZooError: if the name is malformed or taken, also by a shipped model, or the zoo is the installed package's.
    """
    check_name(name)
    zoo = user_zoo() if root is None else Path(root)
    if zoo.resolve().is_relative_to(PACKAGE.resolve()):
        raise ZooError(f"{zoo} is part of the installed package: leave --root out to add to {user_zoo()}.")
    for folder in (zoo / name, *([shipped_folder("zoo") / name] if root is None else [])):
        if (folder / CARD).exists():
            raise ZooError(f"{folder} exists: choose another name, or remove it first.")
    return zoo / name


def round_network(emulator: Emulator) -> Emulator:
    """The emulator as it is loaded again: its network's real weights rounded to float16 where that goes unnoticed.

    Args:
        emulator: In float32; stays as it is.

    Returns:
        A copy with rounded weights; the emulator itself where a rollout notices them.
    """
    half = adapted(emulator, emulator.recipe)
    weights = emulator.state_dict()
    half.load_state_dict({n: v.half().to(v.dtype) if _is_weight(n, v) else v for n, v in weights.items()})
    if not all(value.isfinite().all() for value in half.processor.state_dict().values()):
        return emulator
    moved = golden_distance(Pretrained(half, {}), golden_rollout(emulator))
    return half if moved < NOTICED else emulator


def serialise(emulator: Emulator, precision: torch.dtype) -> bytes:
    """The safetensors file of an emulator's tensors, its network's real weights in a precision of their own."""
    tensors = {n: v.to(precision) if _is_weight(n, v) else v for n, v in emulator.state_dict().items()}
    return save({name: value.contiguous() for name, value in tensors.items()})


def table_text(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Rows as CSV, below the names of their columns."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    return text.getvalue()


def _is_weight(name: str, value: Tensor) -> bool:
    return name.startswith(_NETWORK) and value.is_floating_point()


def _card(
    name: str, about: str, figures: Mapping[str, Any], rows: Sequence[Mapping[str, float]], emulator: Emulator
) -> dict[str, Any]:
    simulation = {"simulation": in_short(figures["simulation"])} if figures.get("simulation") else {}
    return {
        "format": FORMAT,
        "name": name,
        "dataset": figures["dataset"],
        "about": about,
        "license": "MIT",
        "training": figures["training"],
        "test_scenes": len(rows),
        "test": figures["test"],
        "interval": intervals(rows),
        "constraints": dataclasses.asdict(emulator.constraints),
        "obstacles": emulator.scene.obstacles,
        **({"particles": figures["particles"]} if figures.get("particles") else {}),
        **simulation,
        **({"ensemble": figures["ensemble"]} if figures.get("ensemble") else {}),
        "golden": golden_rollout(emulator),
        "versions": figures["versions"],
    }


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise ZooError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise ZooError(f"{path} should hold keys and values.")
    return content
