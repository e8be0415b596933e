"""Entries of the zoo on the Hugging Face hub: downloads of a pinned revision, and uploads with a model card.

Downloads go to the hub's own cache (`HF_HOME`), where a file appears only once it is complete; with `HF_HUB_OFFLINE=1`
nothing but that cache is used. Weights are compared with the card's SHA-256 whenever they are loaded. Private
repositories take the hub's own login (`hf auth login`, `HF_TOKEN`).
"""

from __future__ import annotations

import hashlib
import re
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from nmpm._support.atomic import atomic_folder
from nmpm._support.bounded_files import read_bounded, read_yaml, to_yaml
from nmpm._support.messages import one_line
from nmpm.errors import DataError, ZooError
from nmpm.zoo.card import CARD, FILES, SIMULATED, WEIGHT_BYTES, WEIGHTS

REPOSITORY = r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}"
REVISION = r"[\w./-]{1,100}"


@dataclass(frozen=True)
class HubId:
    """A model on the hub.

    Args:
        repository: "owner/repository".
        revision: A commit, which always means the same files; or a branch or tag, which may move.
    """

    repository: str
    revision: str

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """The id that "owner/repository@revision" means; None for other texts."""
        match = re.fullmatch(f"({REPOSITORY})@({REVISION})", text)
        return None if match is None else cls(*match.groups())

    def __str__(self) -> str:
        return f"{self.repository}@{self.revision}"


def download(identifier: HubId) -> Path:
    """The folder of a model's entry in the hub's cache, downloaded now if it is not there, or damaged.

    Raises:
        ZooError: if there is no such model or revision, it cannot be reached, or its weights are not those of its card.
    """
    from huggingface_hub import constants

    folder = _snapshot(identifier)
    if not (folder / CARD).is_file():
        raise ZooError(f"{identifier} is not a model of nmpm: it has no {CARD}.")
    if _is_whole(folder):
        return folder
    damage = (
        f"{identifier}: its weights are not those that {CARD} was written for (the SHA-256 differs), or one of the two"
        f" cannot be read. If the copy on this machine is damaged, delete {folder.parents[1]} and load it again online."
    )
    try:  # the hub's client would keep what it has
        again = folder if constants.HF_HUB_OFFLINE else _snapshot(identifier, force_download=True)
    except ZooError as error:
        raise ZooError(f"{damage} {error}") from error
    if not _is_whole(again):
        raise ZooError(damage)
    return again


def _is_whole(folder: Path) -> bool:
    """Whether the weights in a folder are those of its card."""
    try:
        weights = read_bounded(folder / WEIGHTS, WEIGHT_BYTES)
        return bool(hashlib.sha256(weights).hexdigest() == read_yaml(folder / CARD).get("sha256"))
    except DataError:
        return False


def _snapshot(identifier: HubId, force_download: bool = False) -> Path:
    """The folder of a model's files in the hub's cache, downloaded where they are not there; raises as `download`."""
    from huggingface_hub import errors, snapshot_download

    name, revision = identifier.repository, identifier.revision
    try:
        return Path(
            snapshot_download(name, revision=revision, allow_patterns=list(FILES), force_download=force_download)
        )
    except errors.RepositoryNotFoundError as error:
        raise ZooError(f"The hub has no model {name}, or it is private: hf auth login.") from error
    except errors.RevisionNotFoundError as error:
        raise ZooError(f"{name} has no revision {revision}.") from error
    except errors.LocalEntryNotFoundError as error:
        raise ZooError(f"{identifier} is not in the cache, and the hub cannot be reached.") from error
    except Exception as error:  # the client's transport raises errors of its own
        raise ZooError(f"{identifier} cannot be downloaded ({type(error).__name__}): {one_line(error)}") from error


def pull(identifier: HubId, target: Path, name: str) -> Path:
    """Copy a model of the hub to the folder of a new entry, after its weights have been compared with its card.

    Card and README have the new name, and the card the commit as `source`. Raises ZooError if the model cannot be
    downloaded or loaded.
    """
    from nmpm.zoo.entries import load_entry  # imports torch

    folder = download(identifier)
    card = dict(load_entry(folder).card) | {"name": name, "source": f"{identifier.repository}@{folder.name}"}
    with atomic_folder(target) as new:
        if target.is_dir():  # variants lie within it
            shutil.copytree(target, new, dirs_exist_ok=True)
        for file in FILES:
            if (folder / file).is_file():
                shutil.copyfile(folder / file, new / file)
        (new / CARD).write_text(to_yaml(card), encoding="utf-8")
        (new / "README.md").write_text(_page(card, new, name), encoding="utf-8")
    return target


def push(entry: Path, repository: str, private: bool = False) -> HubId:
    """Upload an entry as one commit, with the metadata that the hub shows.

    Args:
        entry: Its folder.
        repository: "owner/repository"; created if missing.
        private: Whether the repository has to be private: a new one is made so.

    Returns:
        The id of the commit, under which the model can be loaded for good.

    Raises:
        ZooError: if the entry is damaged, the name is malformed, the repository is public though a private one is asked
            for, or the hub refuses.
    """
    if re.fullmatch(REPOSITORY, repository) is None:
        raise ZooError(f"{one_line(repository, 100)} is not owner/repository.")
    from nmpm.zoo.entries import load_entry  # imports torch

    card = load_entry(entry).card
    with tempfile.TemporaryDirectory() as folder:
        for name in FILES:
            if (entry / name).is_file():
                shutil.copyfile(entry / name, Path(folder) / name)
        page = _page(card, entry, f"{repository}@main")
        (Path(folder) / "README.md").write_text(f"---\n{to_yaml(hub_metadata(card))}---\n\n{page}", encoding="utf-8")
        try:
            return HubId(repository, _upload(folder, repository, private, f"nmpm: {card.get('name', entry.name)}"))
        except ZooError:
            raise
        except Exception as error:  # the client's transport raises errors of its own
            raise ZooError(f"{repository} cannot be uploaded ({type(error).__name__}): {one_line(error)}") from error


def _upload(folder: str, repository: str, private: bool, message: str) -> str:
    """Upload a folder's files as one commit, whose id is returned."""
    from huggingface_hub import HfApi
    from huggingface_hub.errors import RepositoryNotFoundError

    api = HfApi()
    with suppress(RepositoryNotFoundError):
        if private and not api.model_info(repository).private:
            raise ZooError(
                f"{repository} exists and is public: push to another repository, make it private in its settings, or"
                " leave --private out."
            )
    api.create_repo(repository, private=private, exist_ok=True)
    commit = api.upload_folder(
        repo_id=repository,
        folder_path=folder,
        commit_message=message,
        delete_patterns=list(FILES),  # of a former entry that had more of them
    )
    return str(commit.oid)


def _page(card: Mapping[str, Any], entry: Path, load: str) -> str:
    """The README of an entry, by which `Zoo.load(load)` loads it; empty for a card without what it shows."""
    from nmpm.zoo.pages import complete_card, entry_page  # imports jinja2

    with suppress(ZooError), complete_card(load):
        return entry_page(card, [path.name for path in entry.iterdir()], load)
    return ""


def hub_metadata(card: Mapping[str, Any]) -> dict[str, Any]:
    """What the hub's model card states in its head: library, tags, licence, data, metrics and results."""
    dataset = str(card.get("dataset", "")).partition(SIMULATED)[0]
    figures = [
        {"type": "mse", "name": f"rollout {name}", "value": value}
        for name, value in (card.get("test") or {}).items()
        if "/" not in name and isinstance(value, int | float)
    ]
    result = {
        "task": {"type": "other", "name": "particle simulation"},
        "dataset": {"name": dataset or "not stated", "type": dataset or "other"},
        "metrics": figures,
    }
    return {
        "library_name": "nmpm",
        "license": str(card.get("license", "other")).lower(),
        "tags": ["nmpm", "particle-simulation", "physics", "surrogate-model"],
        **({"datasets": [dataset]} if dataset else {}),
        "metrics": ["mse"],
        "model-index": [{"name": str(card.get("name", "model")), "results": [result]}] if figures else [],
    }
