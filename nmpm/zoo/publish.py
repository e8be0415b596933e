"""From a finished run to a zoo entry: recipe, weights and a card made of the run's own measurements."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from safetensors.torch import save

from nmpm.errors import ZooError
from nmpm.evaluation.comparison import PREDICTORS, figure_names, table_row
from nmpm.training.checkpoints import load_module
from nmpm.zoo.registry import check_name


def add(run: Path, name: str, root: Path, about: str = "") -> Path:
    """Turn a run's best checkpoint and report into the zoo entry `root/name`.

    Args:
        run: The run's folder, as `nmpm fit` left it; with a `stress.json` in it, from `nmpm stress --report`, the card
            says how the model fares at the extremes.
        name: What the model is to be called.
        root: The zoo's folder.
        about: What the data are and where they come from, in words, for the card.

    Returns:
        The entry's folder, which appears whole or not at all.

    Raises:
        ZooError: if the run is not finished, or the zoo has an entry of that name.
    """
    checkpoint, report = run / "checkpoints" / "best.ckpt", run / "report.json"
    for needed in (checkpoint, report):
        if not needed.is_file():
            raise ZooError(f"{run} is not a finished run: {needed} is missing. Let `nmpm fit` end with its test.")
    target = root / check_name(name)
    if (target / "card.yaml").exists():
        raise ZooError(f"{target} exists: choose another name, or remove it first.")
    module = load_module(checkpoint)
    weights = save({key: value.contiguous() for key, value in module.emulator.state_dict().items()})
    figures = json.loads(report.read_text())
    card = _card(name, about, figures, hashlib.sha256(weights).hexdigest())
    if (run / "stress.json").is_file():
        card["stress"] = stress_digest(json.loads((run / "stress.json").read_text()))
    target.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=".adding-", dir=target.parent))
    try:
        (part / "model.safetensors").write_bytes(weights)
        (part / "config.yaml").write_text(_yaml(module.emulator.recipe.to_dict()))
        (part / "card.yaml").write_text(_yaml(card))
        (part / "README.md").write_text(_readme(card, (run / "rollout.png").is_file()))
        if (run / "rollout.png").is_file():
            shutil.copyfile(run / "rollout.png", part / "rollout.png")
        part.chmod(0o755)
        os.replace(part, target)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return target


def stress_digest(report: Mapping[str, Any]) -> dict[str, Any]:
    """What a card says of `nmpm stress`: how much was run, how many lines passed, and which failed."""
    lines = report["lines"]
    return {
        "size": report["size"],
        "passed": sum(line["passed"] is True for line in lines),
        "failed": [f"{line['group']}: {line['name']}" for line in lines if line["passed"] is False],
    }


def _card(name: str, about: str, figures: Mapping[str, Any], digest: str) -> dict[str, Any]:
    return {
        "name": name,
        "dataset": figures["dataset"],
        "about": about,
        "license": "MIT",
        "sha256": digest,
        "test": figures["test"],
        "per_trajectory": figures["per_trajectory"]["model"],
        "training": figures["training"],
        "versions": figures["versions"],
    }


def _readme(card: Mapping[str, Any], pictured: bool) -> str:
    training, test = card["training"], card["test"]
    names = figure_names(test)
    rows = [[label, *table_row(test, kind)] for kind, label in PREDICTORS.items()]
    lines = [
        f"# {card['name']}",
        "",
        f"An emulator of: {card['dataset']}. {card['about']}".rstrip(),
        "",
        "Test error ×10⁻³, from full rollouts: MSE over frames 1 … h in domain length² (`mse`: over all frames), "
        "exact earth mover's distance (`emd`) in domain length.",
        "",
        f"| predictor | {' | '.join(names)} |",
        f"|---|{'---:|' * len(names)}",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        f"Trained for {training['steps']} steps in {training['seconds'] / 60:.1f} minutes on {training['hardware']}, "
        f"{training['precision']}; {training['parameters']:,} parameters.",
        "",
        *_stressed(card),
        "```python",
        "from nmpm import Zoo",
        "",
        f'model = Zoo.load("{card["name"]}")',
        "positions = model.rollout(model.example(), frames=400)  # (1, 400, N, D)",
        "```",
    ]
    lines += ["", "![rollout](rollout.png)"] if pictured else []
    return "\n".join(lines) + "\n"


def _stressed(card: Mapping[str, Any]) -> list[str]:
    if "stress" not in card:
        return []
    found = card["stress"]
    failed = "; ".join(found["failed"]) or "none"
    return [f"`nmpm stress`, {found['size']}: {found['passed']} lines passed; failed: {failed}.", ""]


def _yaml(content: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True, width=120)
