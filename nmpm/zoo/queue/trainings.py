"""Progress of the trainings of a dataset, read from their folders alone: a process may be killed at any time."""

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
from nmpm.zoo.queue.plan import RATE, Dataset, Extension, continued_training, new_training
from nmpm.zoo.queue.published import Published
from nmpm.zoo.queue.validations import ends_lowest, lowest_errors
from nmpm.zoo.runs import BEST

LAST = BEST.with_name("last.ckpt")
WORDS = "words.json"
CONFIG = "queued.yaml"
COPY = "published"
"""Folder beside the trainings with the entry that the first one started from."""


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


@dataclass(frozen=True)
class History:
    """The trainings of a dataset.

    Args:
        dataset: What is trained.
        folder: Of the dataset's trainings, called 1, 2, ….
        extension: How the trainings after the first one are made, and when they stop.
        entry: Folder of the dataset's entry in the zoo, from whose weights the first training goes on, where there is
            one; None to train from random weights.
    """

    dataset: Dataset
    folder: Path
    extension: Extension
    entry: Path | None = None

    @property
    def trainings(self) -> list[Training]:
        """Those that have been started, in order."""
        found: list[Training] = []
        while (path := self.folder / str(len(found) + 1) / WORDS).is_file():
            found.append(Training(path.parent))
        return found

    @property
    def starting_entry(self) -> Published | None:
        """The entry that the first training goes on from; None where it starts from random weights."""
        copy = Published.find(self.folder / COPY)
        if copy is not None or self.entry is None or self.trainings:
            return copy
        return Published.find(self.entry)

    @property
    def stages(self) -> list[Published | Training]:
        """The entry that the first training goes on from, where there is one, and the trainings."""
        entry = self.starting_entry
        return [*([] if entry is None else [entry]), *self.trainings]

    def best(self) -> Training | None:
        """The training of the lowest validation error; None before the first validation."""
        validated = [training for training in self.trainings if training.best.is_file() and training.curve()]
        errors = lowest_errors(*(training.curve() for training in validated))
        return validated[errors.index(min(errors))] if validated else None

    def hours(self) -> float:
        """Hours of training so far, with those of the entry that the first training goes on from."""
        return sum(stage.seconds() for stage in self.stages) / 3600

    def next_round(self) -> int | None:
        """Number of the training to start or to go on with, from 1; None when the dataset stops."""
        trainings = self.trainings
        if trainings and not trainings[-1].finished:
            return len(trainings)
        return None if (trainings or self.starting_entry) and self.stops() else len(trainings) + 1

    def stops(self) -> bool:
        """Whether the finished trainings end the dataset: hours are over, or the last extension gained too little."""
        trainings, extension = self.trainings, self.extension
        if self.planned_hours(len(trainings) + 1) > extension.limit + 1e-9 or self.hours_of(len(trainings) + 1) <= 0:
            return True
        errors = lowest_errors(*(stage.curve() for stage in self.stages))
        return bool(trainings) and len(errors) > 1 and errors[-1] > (1 - extension.gain) * min(errors[:-1])

    def hours_of(self, number: int) -> float:
        """Hours of the training of that number: what the dataset still lacks, else those of an extension."""
        return self.extension.hours if number > 1 else self._hours_of_first(self._hours_of_entry())

    def planned_hours(self, count: int) -> float:
        """Hours of so many trainings, at least one, and of the entry that the first one goes on from."""
        done = self._hours_of_entry()
        return done + self._hours_of_first(done) + (count - 1) * self.extension.hours

    def entry_has_hours(self) -> bool:
        """Whether the entry that the first training goes on from was trained for the dataset's hours, to 5%."""
        return self._hours_of_entry() >= 0.95 * self.dataset.hours

    def _hours_of_entry(self) -> float:
        entry = self.starting_entry
        return 0.0 if entry is None else entry.seconds() / 3600

    def _hours_of_first(self, done: float) -> float:
        """Hours of the first training, after so many hours of the entry that it goes on from."""
        return max(self.dataset.hours - done, self.extension.hours) if done else self.dataset.hours

    def dataset_of(self, number: int) -> Dataset:
        """The dataset with the values of the training of that number."""
        goes_on = number > 1 or self.starting_entry is not None
        return self.dataset.extended() if goes_on else self.dataset

    def open(self, number: int) -> Training:
        """The training of that number, started if it has not been."""
        trainings = self.trainings
        if number <= len(trainings):
            return trainings[number - 1]
        dataset, hours = self.dataset_of(number), self.hours_of(number)
        training, weights = Training(self.folder / str(number)), self._weights()
        training.start(
            new_training(dataset)
            if weights is None
            else continued_training(dataset, hours, self.extension.rate, weights)
        )
        return training

    def _weights(self) -> Path | None:
        """What the next training starts from: the best weights so far; None for random ones."""
        best, entry = self.best(), self.starting_entry
        if entry is not None and entry.folder != self.folder / COPY:
            entry = entry.copy_to(self.folder / COPY)
        if entry is not None:
            trained = [] if best is None else best.curve()
            entry_error, trained_error = lowest_errors(entry.curve(), trained)
            if entry_error <= trained_error:
                return entry.folder
        if best is None and self.dataset.start and not self.trainings:
            best = self._origin().best()
        return None if best is None else best.best

    def waits_for(self) -> str:
        """What the first training waits for, in words: data or another training; empty where nothing is missing."""
        if self.dataset.lacks_data:
            return f"--data {self.dataset.name}=FOLDER"
        if self.starting_entry is not None:
            return ""
        origin = self._origin().trainings
        return "" if not self.dataset.start or (origin and origin[0].finished) else self.dataset.start

    def _origin(self) -> History:
        """The trainings that the first one starts from."""
        return History(self.dataset, self.folder.parent / self.dataset.start, self.extension)

    def hours_left(self) -> tuple[float, float]:
        """Hours of training that are left without further extensions, and with all that the limit allows."""
        trainings, extension = self.trainings, self.extension
        count = max(len(trainings), 1)
        finished = trainings[-1].finished if trainings else self.next_round() is None
        done = trainings[-1].seconds() / 3600 if trainings else 0.0
        left = 0.0 if finished else max(self.hours_of(count) - done, 0.0)
        if self.next_round() is None or extension.hours <= 0:
            return left, left
        return left, left + max(extension.limit - self.planned_hours(count), 0.0)

    def curve(self) -> list[list[float]]:
        """Seconds, steps and validation errors over all trainings, one after the other."""
        points: list[list[float]] = []
        seconds, steps = 0.0, 0
        for stage in self.stages:
            points += [[round(seconds + s, 1), steps + int(n), *errors] for s, n, *errors in stage.curve()]
            seconds, steps = seconds + stage.seconds(), steps + stage.steps()
        return points
