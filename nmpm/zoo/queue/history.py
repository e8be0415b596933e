"""The trainings of a dataset one after the other, and what comes next; read from their folders alone."""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

from nmpm.zoo.queue.plan import Dataset, Extension, continued_training, new_training
from nmpm.zoo.queue.published import Published
from nmpm.zoo.queue.training import WORDS, Training
from nmpm.zoo.queue.validations import lowest_errors

_NEARLY = 0.95
"""Share of its hours from which on a training counts as done: each ends a little before or after its time."""
COPY = "published"
"""Folder beside the trainings with the entry that the first one started from."""


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
        if self.trainings:
            return Published.find(self.folder / COPY)
        return None if self.entry is None else Published.find(self.entry)

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
        """Whether the finished trainings end the dataset.

        So it is where hours are over, or the last training gained too little with the options of the next one; before
        the first training, by what the card of the entry states of its last one.
        """
        following = len(self.trainings) + 1
        if not self._fits(following) or self.hours_of(following) <= 0:
            return True
        recipe = self.dataset_of(following).recipe()
        if self.trainings:
            gain = self.last_gain() if self.trainings[-1].recipe() == recipe else None
        else:
            entry = self.starting_entry
            gain = entry.last_gain(recipe) if entry is not None and self.entry_has_hours() else None
        return gain is not None and gain < self.extension.gain

    def last_gain(self) -> float | None:
        """Share of the validation error by which the last training lowered what all before it had reached.

        None before the first training has ended, while one goes on, and where no earlier error is known.
        """
        trainings = self.trainings
        if not trainings:
            return None
        *former, last = lowest_errors(*(stage.curve() for stage in self.stages))
        if not trainings[-1].finished or not former or not math.isfinite(min(former)):
            return None
        return 1 - last / min(former) if min(former) > 0 else 0.0

    def _fits(self, count: int) -> bool:
        """Whether the limit leaves nearly the hours of the last of so many trainings."""
        beyond = self.planned_hours(count) - self.extension.limit
        return beyond <= (1 - _NEARLY) * self.hours_of(count) + 1e-9

    def hours_of(self, number: int) -> float:
        """Hours of the training of that number: what the dataset still lacks, else those of an extension."""
        return self.extension.hours if number > 1 else self._hours_of_first(self._hours_of_entry())

    def planned_hours(self, count: int) -> float:
        """Hours of so many trainings, at least one, and of the entry that the first one goes on from."""
        done = self._hours_of_entry()
        return done + self._hours_of_first(done) + (count - 1) * self.extension.hours

    def entry_has_hours(self) -> bool:
        """Whether the entry that the first training goes on from was trained for nearly the dataset's hours."""
        return self._hours_of_entry() >= _NEARLY * self.dataset.hours

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
        if not trainings and self.starting_entry is None:
            shutil.rmtree(self.folder / COPY, ignore_errors=True)  # left by a process that died before it could start
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
        runs = self.folder.parents[len(Path(self.dataset.name).parts) - 1]
        return History(self.dataset, runs / self.dataset.start, self.extension)

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
