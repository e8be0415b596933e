"""One training of a dataset, read from its folder alone: a process may be killed at any time."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import read_yaml
from nmpm._support.shipped import find_config
from nmpm.errors import DataError
from nmpm.training.checkpoints import read_checkpoint
from nmpm.zoo.queue.plan import RATE, recipe_of
from nmpm.zoo.queue.validations import ends_lowest
from nmpm.zoo.runs import BEST

LAST = BEST.with_name("last.ckpt")
WORDS = "words.json"
CONFIG = "queued.yaml"


@dataclass(frozen=True)
class Training:
    """One training of a dataset: a run's folder with the command that it was started by.

    Args:
        folder: Of the run.
    """

    folder: Path

    @property
    def finished(self) -> bool:
        """Whether it has ended with its test."""
        return (self.folder / "report.json").is_file()

    @property
    def best(self) -> Path:
        """The checkpoint of the lowest validation error, see `ends_lowest`; may not exist yet."""
        last = self.folder / LAST
        curve = self.curve() if self.finished and last.is_file() else []
        return last if curve and ends_lowest(curve) else self.folder / BEST

    def start(self, words: list[str]) -> None:
        """Write its command, and a copy of its configuration, so that changes of the shipped one do not reach it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(find_config(words[words.index("--config") + 1]), self.folder / CONFIG)
        self._write(words)

    def command(self) -> list[str]:
        """The arguments of `nmpm` that start it or go on with it."""
        words = [*self._words(), "--trainer.default_root_dir", str(self.folder)]
        if (self.folder / LAST).is_file():
            return [*words, "--ckpt_path", "last"]
        for left in (path for path in self.folder.glob("*") if path.name not in (WORDS, CONFIG)):
            shutil.rmtree(left) if left.is_dir() else left.unlink()  # of a process that died before a checkpoint
        return words

    def slow_down(self, factor: float) -> float:
        """After a divergence: have it go on from its best weights, or start anew, at a lower learning rate.

        Args:
            factor: Of the rate so far.

        Returns:
            The new rate.
        """
        words, option, rate = self._words(), f"--{RATE}", factor * float(self._stated(RATE))
        if option in words:
            words[words.index(option) + 1] = str(rate)
        else:
            words += [option, str(rate)]
        if self.best.is_file():
            with atomic_write(self.folder / LAST) as part:
                shutil.copyfile(self.best, part)
        else:
            (self.folder / LAST).unlink(missing_ok=True)
        self._write(words)
        return rate

    def test_command(self, folder: Path) -> list[str]:
        """The arguments of `nmpm` that test the best weights, of which another folder has a copy.

        In float32, as `Zoo.load` runs them.
        """
        words = self._words()
        if "--start_from" in words:
            at = words.index("--start_from")
            del words[at : at + 2]
        own = {"default_root_dir": str(folder), "precision": "32-true", "logger": "false"}
        options = [word for key, value in own.items() for word in (f"--trainer.{key}", value)]
        return ["test", *words[1:], *options, "--ckpt_path", "best", "--verbose", "false"]

    def recipe(self) -> dict[str, str]:
        """The options that it was started with, see `recipe_of`."""
        return recipe_of(json.loads((self.folder / WORDS).read_text(encoding="utf-8")))

    def curve(self) -> list[list[float]]:
        """Seconds of training, steps, MSE and overall error of each validation so far."""
        return [list(point) for point in self._record().get("curve", [])]

    def seconds(self) -> float:
        """Seconds of training so far, as of its last checkpoint."""
        return float(self._trained("seconds") or 0.0)

    def steps(self) -> int:
        """Steps of training so far, as of its last checkpoint."""
        return int(self._trained("steps") or 0)

    def precision(self) -> str:
        """Precision of the training so far, as of its last checkpoint; before, what its configuration states."""
        return str(self._trained("precision") or self._stated("trainer.precision") or "32-true")

    def hardware(self) -> str:
        """What it was trained on so far, as of its last checkpoint; empty before, or where an earlier version ran."""
        return str(self._trained("hardware") or "")

    def _trained(self, figure: str) -> Any:
        """What the report states of the training, or before there is one the last checkpoint; None in neither."""
        record = self._record()
        return record.get("training", record).get(figure, record.get(f"trained_{figure}"))

    def _stated(self, key: str) -> Any:
        """The value of a key of the configuration in its command, or else in its configuration; None in neither."""
        words = self._words()
        if f"--{key}" in words:
            return words[words.index(f"--{key}") + 1]
        value: Any = read_yaml(self.folder / CONFIG)
        for part in key.split("."):
            value = (value or {}).get(part)
        return value

    def _write(self, words: list[str]) -> None:
        with atomic_write(self.folder / WORDS) as part:
            part.write_text(json.dumps(words, indent=1), encoding="utf-8")

    def _words(self) -> list[str]:
        words: list[str] = json.loads((self.folder / WORDS).read_text(encoding="utf-8"))
        words[words.index("--config") + 1] = str(self.folder / CONFIG)
        return words

    def _record(self) -> dict[str, Any]:
        """The report; before there is one, what the report's writer has in the last checkpoint."""
        if self.finished:
            report: dict[str, Any] = json.loads((self.folder / "report.json").read_text(encoding="utf-8"))
            return report
        found: list[dict[str, Any]] = [{}]
        for path in (self.folder / LAST, self.best):
            try:
                found.append(read_checkpoint(path).get("callbacks", {}).get("Report", {}))
            except DataError:  # missing, or damaged
                continue
        return max(found, key=lambda state: state.get("trained_seconds", 0.0))
