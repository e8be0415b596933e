"""The folder of a training run: one fit at a time, and no new run over an old one."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import lock_descriptor

from nmpm._support.atomic import temporary_files
from nmpm.errors import ConfigError

CONFIG = "config.yaml"
"""The file of a run's folder that holds its configuration."""
CHECKPOINTS = "checkpoints"
"""The folder of a run's checkpoints, unless its configuration names another."""
SAVERS = {"best": "checkpoint", "last": "resume"}
"""Sections of a configuration that save checkpoints, by the names that `--ckpt_path` takes for them."""


@dataclass(frozen=True)
class RunFolder:
    """Where a run keeps its files.

    Args:
        root: Of report, pictures and logs.
        checkpoints: Files of checkpoints by the names that `--ckpt_path` takes: "last" and "best".
    """

    root: Path
    checkpoints: Mapping[str, Path]

    @classmethod
    def of(cls, root: Path, config: Mapping[str, Any]) -> RunFolder:
        """The folder of a run with this configuration."""
        checkpoints = {}
        for name, saver in SAVERS.items():
            section = config.get(saver) or {}
            folder = Path(section.get("dirpath") or root / CHECKPOINTS)
            checkpoints[name] = folder / f"{section.get('filename') or name}.ckpt"
        return cls(root, checkpoints)

    def lock(self) -> int:
        """Keep other processes from training in this folder until the descriptor that is returned is closed.

        The lock is the operating system's: it ends with the process, however it ends. Where the file system has none,
        nothing is locked.

        Raises:
            ConfigError: if another process trains here.
        """
        self.root.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.root / ".lock", os.O_RDWR | os.O_CREAT)
        try:
            locked = lock_descriptor(descriptor, blocking=False)
        except OSError:
            return descriptor
        if not locked:
            holder = os.read(descriptor, 20).decode() or "unknown"
            os.close(descriptor)
            raise ConfigError(
                f"Another process ({holder}) is training in {self.root}. Wait for it, or choose another folder with"
                " --trainer.default_root_dir."
            )
        os.truncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())
        return descriptor

    def remove_unfinished(self) -> None:
        """Delete files that a process was writing when it was killed. Needs the folder's lock."""
        inner = {path.parent for path in self.checkpoints.values() if path.is_relative_to(self.root)}
        for unfinished in [file for folder in {self.root, *inner} for file in temporary_files(folder)]:
            unfinished.unlink(missing_ok=True)

    def holds(self, checkpoint: Path) -> bool:
        """Whether a checkpoint is one of this run, whatever path leads to it."""
        return checkpoint.resolve().parent in {path.resolve().parent for path in self.checkpoints.values()}

    def check_new(self) -> None:
        """Raise ConfigError if there is a checkpoint or a report, which a new run would write over."""
        folders = {path.parent for path in self.checkpoints.values()}
        old = [path for folder in folders for path in folder.glob("*.ckpt")]
        old += [path for path in [self.root / "report.json"] if path.is_file()]
        if old:
            last = self.checkpoints["last"].is_file()
            resume = f"Go on with it by nmpm fit --resume {self.root}" if last else "Remove it"
            raise ConfigError(
                f"{self.root} already holds a run ({old[0].name}). {resume}, or choose another folder with"
                " --trainer.default_root_dir."
            )

    def checkpoint(self, *names: str) -> Path:
        """The file of the first of the checkpoints, "best" or "last", that exists.

        Raises:
            ConfigError: if there is none.
        """
        paths = [self.checkpoints[name] for name in names]
        for path in paths:
            if path.is_file():
                return path
        others = ", ".join(path.name for path in sorted(paths[0].parent.glob("[!.]*.ckpt"))) or "none"
        raise ConfigError(
            f"{self.root}: there is no {' or '.join(map(str, paths))}; checkpoints there: {others}. To start a new run,"
            " call nmpm fit with --config alone."
        )
