"""A dataset of a few small trajectories, for tests of what simulates and writes datasets."""

import dataclasses
import hashlib
from pathlib import Path

from nmpm.sim import load_preset

GOOP = load_preset("goop")
TINY = dataclasses.replace(GOOP, frames=20, blocks=dataclasses.replace(GOOP.blocks, particles=(60, 90)))
COUNTS = {"train": 4, "valid": 1, "test": 2}


def fingerprints(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a folder, by its name."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir() if path.is_file()}
