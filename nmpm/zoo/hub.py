"""Entries of the zoo on the Hugging Face hub: downloads of a pinned revision, and uploads with a model card.

Downloads go to the hub's own cache (`HF_HOME`), where a file appears only once it is complete; with `HF_HUB_OFFLINE=1`
nothing but that cache is used. Weights are compared with the card's SHA-256 whenever they are loaded. Private
repositories take the hub's own login (`hf auth login`, `HF_TOKEN`).
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import yaml

from nmpm._support.atomic import atomic_folder
from nmpm._support.messages import one_line
from nmpm.errors import ZooError
from nmpm.zoo.cards import PICTURES
from nmpm.zoo.entries import CARD, load_entry, read_card
from nmpm.zoo.pretrained import SIMULATED

FILES = (CARD, "config.yaml", "model.safetensors", "README.md", *PICTURES, "errors.csv")
"""Files of an entry that are uploaded and downloaded."""
ID = re.compile(r"(?P<repository>[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95})@(?P<revision>[\w./-]{1,100})")
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}")


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
        found = ID.fullmatch(text)
        return None if found is None else cls(found["repository"], found["revision"])

    def __str__(self) -> str:
        return f"{self.repository}@{self.revision}"


def download(identifier: HubId) -> Path:
    """The folder of a model's entry in the hub's cache, downloaded now if it is not there.

    Raises:
        ZooError: if there is no such model or revision, or it cannot be reached.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import (
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    try:
        folder = Path(
            snapshot_download(identifier.repository, revision=identifier.revision, allow_patterns=list(FILES))
        )
    except RepositoryNotFoundError as error:
        raise ZooError(f"The hub has no model {identifier.repository}, or it is private: hf auth login.") from error
    except RevisionNotFoundError as error:
        raise ZooError(f"{identifier.repository} has no revision {identifier.revision}.") from error
    except LocalEntryNotFoundError as error:
        raise ZooError(f"{identifier} is not in the cache, and the hub cannot be reached.") from error
    except Exception as error:  # the client's transport raises errors of its own
        raise ZooError(f"{identifier} cannot be downloaded ({type(error).__name__}): {one_line(error)}") from error
    if not (folder / CARD).is_file():
        raise ZooError(f"{identifier} is not a model of nmpm: it has no {CARD}.")
    return folder


def pull(identifier: HubId, target: Path) -> Path:
    """Copy a model of the hub to a new entry, after its weights have been compared with its card.

    Raises:
        ZooError: as `download`; if the entry exists, or the model cannot be loaded.
    """
    if (target / CARD).exists():
        raise ZooError(f"{target} exists: choose another name, or remove it first.")
    folder = download(identifier)
    load_entry(folder)
    with atomic_folder(target) as new:
        if target.is_dir():  # variants lie within it
            shutil.copytree(target, new, dirs_exist_ok=True)
        for name in FILES:
            if (folder / name).is_file():
                shutil.copyfile(folder / name, new / name)
    return target


def push(entry: Path, repository: str, private: bool = False) -> HubId:
    """Upload an entry as one commit, with the metadata that the hub shows.

    Args:
        entry: Its folder.
        repository: "owner/repository"; created if missing.
        private: Whether a new repository is private.

    Returns:
        The id of the commit, under which the model can be loaded for good.

    Raises:
        ZooError: if the entry is damaged, the name is malformed, or the hub refuses.
    """
    from huggingface_hub import HfApi

    if REPOSITORY.fullmatch(repository) is None:
        raise ZooError(f"{one_line(repository, 100)} is not owner/repository.")
    load_entry(entry)
    with tempfile.TemporaryDirectory() as folder:
        for name in FILES:
            if (entry / name).is_file():
                shutil.copyfile(entry / name, Path(folder) / name)
        readme = Path(folder) / "README.md"
        text = readme.read_text(encoding="utf-8") if readme.is_file() else ""
        metadata = yaml.safe_dump(hub_metadata(read_card(entry)), sort_keys=False, allow_unicode=True)
        readme.write_text(f"---\n{metadata}---\n\n{text}", encoding="utf-8")
        api = HfApi()
        try:
            api.create_repo(repository, private=private, exist_ok=True)
            commit = api.upload_folder(repo_id=repository, folder_path=folder, commit_message=f"nmpm: {entry.name}")
        except Exception as error:  # the client's transport raises errors of its own
            raise ZooError(f"{repository} cannot be uploaded ({type(error).__name__}): {one_line(error)}") from error
    return HubId(repository, str(commit.oid))


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
