"""The folder of a training run: one fit at a time, and each new run in a folder of its own."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
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

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from training in this folder.

        The lock is the operating system's: it ends with the process, however it ends. Where the file system has none,
        nothing is locked.

        Raises:
            ConfigError: if another process trains here.
        """
        self.root.mkdir(parents=True, exist_ok=True)
        with open(os.open(self.root / ".lock", os.O_RDWR | os.O_CREAT), "r+", encoding="utf-8") as file:
            with suppress(OSError):
                if not lock_descriptor(file.fileno(), blocking=False):
                    raise ConfigError(
                        f"Another process ({file.read(20) or 'unknown'}) is training in {self.root}. Wait for it, or"
                        " choose another folder with --trainer.default_root_dir."
                    )
                file.truncate(0)
                file.write(str(os.getpid()))
                file.flush()
            yield

    def remove_unfinished(self) -> None:
        """Delete files that a process was writing when it was killed. Needs the folder's lock."""
        inner = {path.parent for path in self.checkpoints.values() if path.is_relative_to(self.root)}
        for unfinished in [file for folder in {self.root, *inner} for file in temporary_files(folder)]:
            unfinished.unlink(missing_ok=True)

    def holds(self, checkpoint: Path) -> bool:
        """Whether a checkpoint is one of this run, whatever path leads to it."""
        return checkpoint.resolve().parent in {path.resolve().parent for path in self.checkpoints.values()}

    def results(self) -> list[Path]:
        """Checkpoints and the report, which a new run would write over."""
        folders = {path.parent for path in self.checkpoints.values()}
        checkpoints = [path for folder in folders for path in folder.glob("*.ckpt")]
        return checkpoints + [path for path in [self.root / "report.json"] if path.is_file()]

    @property
    def unfinished(self) -> bool:
        """Whether the run was interrupted, and can go on."""
        return self.checkpoints["last"].is_file() and not (self.root / "report.json").is_file()

    def check_new(self) -> None:
        """Raise ConfigError if a new run would write over results."""
        if results := self.results():
            raise ConfigError(
                f"{results[0]} is of another run, and would be written over: choose other folders with"
                " --trainer.default_root_dir, --checkpoint.dirpath and --resume.dirpath."
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
        others = [path.name for path in sorted(paths[0].parent.glob("[!.]*.ckpt"))]
        mend = "To start a new run, call nmpm fit with --config alone."
        if others:
            mend = f"To go on from one, give --ckpt_path {paths[0].parent / others[0]}."
        raise ConfigError(
            f"{self.root}: there is no {' or '.join(map(str, paths))}; checkpoints there:"
            f" {', '.join(others) or 'none'}. {mend}"
        )

    def next_commands(self, data: str, facts: Sequence[str] = ()) -> str:
        """What to do with a run that has been trained on data, a name or a path: three commands, a line each.

        `facts` are options by which the commands are told what the data lack.
        """
        root, data = shlex.quote(str(self.root)), shlex.join([data, *facts])
        commands = {
            f"nmpm rollout {root} --data {data}": "a test scene beside its prediction, to view and to render",
            f"nmpm trade {data} --models {root}": "its time and errors, beside the simulator's if there is one",
            f"nmpm zoo add {root} NAME": "keep it, under a name that every command takes",
        }
        width = max(map(len, commands))
        lines = [f"  {command:<{width}}  {purpose}\n" for command, purpose in commands.items()]
        return "next:\n" + "".join(lines)


def next_folder(root: Path) -> tuple[Path, str]:
    """The first of root, root/version_1, root/version_2, … without results of a run, and a line about those before it.

    All ranks of a training find the same one: none writes results before all have started.
    """
    former, folder = [], RunFolder.of(root, {})
    while folder.results():
        former.append(folder)
        folder = RunFolder.of(root / f"version_{len(former)}", {})
    unfinished = [run.root for run in former if run.unfinished]
    if not unfinished:
        return folder.root, f"{former[-1].root} holds a run; this is a new one.\n" if former else ""
    last, command = unfinished[-1], shlex.join(["nmpm", "fit", "--resume", str(unfinished[-1])])
    return folder.root, f"{last} holds an unfinished run, with which {command} goes on; this is a new one.\n"
