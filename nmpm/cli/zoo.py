"""`nmpm zoo list | card NAME | match DATA | add RUN NAME | verify NAME | refresh NAME | push NAME ID | pull ID`."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from nmpm._support.messages import one_line
from nmpm._support.shipped import user_zoo
from nmpm.cli.command import Command, option, positional
from nmpm.cli.options import DeviceOptions, Existing, FactOptions, ReadingOptions, check_model, derived_name
from nmpm.errors import ConfigError, NmpmError, ZooError

if TYPE_CHECKING:
    from nmpm.zoo.ranking import Standing


@dataclass(frozen=True, kw_only=True)
class _ZooCommand(Command):
    """A command about a zoo.

    Args:
        root: Folder of another zoo (default: your own, NMPM_HOME/zoo or ~/.cache/nmpm/zoo, and the shipped one).
        name: Name, an entry's folder, or owner/repository@revision of the hub.
    """

    root: Path | None = None


class List(_ZooCommand):
    """Names, data and full-rollout errors of the models."""

    def run(self) -> None:
        from nmpm.evaluation.figures import with_unit
        from nmpm.zoo.card import lifecycle, stated_error
        from nmpm.zoo.registry import Zoo

        for name in Zoo.list(self.root):
            own = "yours" if self.root is None and Zoo.folder(name).is_relative_to(user_zoo()) else ""
            try:
                card = Zoo.card(name, self.root)
                mse, dataset = stated_error(card), one_line(card.get("dataset", "data not stated"))
                error_text = "not measured" if mse is None else with_unit(mse)
                state, text = lifecycle(card), f"full-rollout MSE {error_text}   {dataset}"
            except ZooError as error:
                state, text = "", str(error)
            sys.stdout.write(f"{name:<20} {own:<6} {state:<10} {text}\n")


@dataclass(frozen=True, kw_only=True)
class Card(_ZooCommand):
    """Errors, times, training and known failures of one model, and what computes it here.

    Args:
        yaml: Everything known of it, for programs.
    """

    name: str
    yaml: bool = False

    def run(self) -> None:
        from nmpm._support.bounded_files import to_yaml
        from nmpm.zoo.card import read_card
        from nmpm.zoo.registry import find_entry, load_model

        card = read_card(find_entry(self.name, self.root))
        if self.yaml:
            sys.stdout.write(to_yaml(card))
            return
        from nmpm.zoo.pages import complete_card, entry_page  # imports torch

        with complete_card(self.name):
            text = entry_page(card)
        try:
            runs = load_model(self.name, root=self.root).emulator.explain()
        except NmpmError as error:
            runs = f"The model cannot be loaded: {error}"
        text = f"{text.rstrip()}\n\n## What runs here\n\n```text\n{runs}\n```\n"
        if not sys.stdout.isatty():
            sys.stdout.write(text)
            return
        from rich.console import Console
        from rich.markdown import Markdown

        Console().print(Markdown(text))


@dataclass(frozen=True, kw_only=True)
class MatchModels(_ZooCommand, ReadingOptions, FactOptions):
    """Predict a few windows of your data by every model: which to use, and to start a fine-tuning from.

    Args:
        data: A dataset, of any format that nmpm convert reads.

    Examples:
        nmpm zoo match grains
        nmpm zoo match grains.npz --materials big=sand,small=sand
        nmpm zoo match waterdrop --family deepmind --gravity 0,-9.81
    """

    data: Existing

    def run(self) -> None:
        from rich.console import Console

        from nmpm._support.progress import progress_bar
        from nmpm.data.dataset import Dataset
        from nmpm.data.sources import FolderSource
        from nmpm.zoo.ranking import Ranking, Trial, ranking_table
        from nmpm.zoo.registry import Zoo, load_model

        trial = Trial.of(Dataset(FolderSource(self.data, self.facts)))
        names = Zoo.list(self.root)
        loaders = {name: (lambda name=name: load_model(name, root=self.root).emulator) for name in names}
        with progress_bar("models", len(names)) as step:
            standings = Ranking(trial, self.match.materials, self.match.stride).rank(loaders, step)
        Console().print(ranking_table(trial, standings))
        best = next((one for one in standings if one.match is not None and math.isfinite(one.error)), None)
        sys.stdout.write("".join(f"{line}\n" for line in self._advice(best)))

    def _advice(self, best: Standing | None) -> list[str]:
        """What could not be matched of the best model, and the commands that use it."""
        if best is None or best.match is None:
            return ["No model takes these data: nmpm init writes a configuration for a training from nothing."]
        lines = [f"warning: {warning}" for warning in best.match.warnings]
        if best.error >= 1:
            lines.append("No model is better than a trivial predictor; a fine-tuning may be.")
        materials, facts, data = best.pairs(","), self.arguments, str(self.data)
        stated = [*(["--materials", materials] * bool(materials)), *(["--stride", self.stride] if self.stride else [])]
        if facts:
            data = derived_name(self.data, "").name + "-stated"
            lines.append(f"first state it:   {shlex.join(['nmpm', 'convert', str(self.data), data, *facts])}")
        calls = {
            "as it is:": ["rollout", best.model, "--data", data],
            "to start from it:": ["fit", "--start_from", best.model, "--data.path", data],
        }
        return [*lines, *(f"{how:<17} {shlex.join(['nmpm', *call, *stated])}" for how, call in calls.items())]


@dataclass(frozen=True, kw_only=True)
class Add(_ZooCommand):
    """Make an entry of your own zoo, or of --root, from a finished run.

    Args:
        folder: The run's folder, e.g. runs/goop.
        name: Name of the new model, e.g. goop/mine.
        about: Description of the data and their origin, for the card.
    """

    folder: Path
    name: str
    about: str = ""

    def run(self) -> None:
        from nmpm.zoo.publish import add

        sys.stdout.write(f"added {add(self.folder, self.name, self.root, self.about)}\n")


@dataclass(frozen=True, kw_only=True)
class Verify(_ZooCommand, DeviceOptions):
    """Measure the figures of cards again; 1 if one is not confirmed.

    Args:
        name: Name, an entry's folder, or owner/repository@revision of the hub (default: every model).
        full: All test scenes to their end (default: a few, 100 frames).
        data: Test data, of models of recorded data.
    """

    name: str | None = positional()
    full: bool = False
    data: Path | None = option(metavar="FOLDER")

    def run(self) -> int:
        """Verify a model, which must be possible; or all, of which those of recorded data may be left out.

        Of all, a damaged one counts as a figure that is not confirmed.
        """
        from nmpm.zoo.registry import Zoo, find_entry

        _check_one("--data is the folder of one model's data", self.data, self.name)
        if self.name is not None:
            check_model(self.name, self.root)
        from nmpm.zoo.verification import verify_entry  # imports torch

        failed, left_out = 0, []
        for name in Zoo.list(self.root) if self.name is None else [self.name]:
            sys.stdout.write(f"{name}\n")
            try:
                for check in verify_entry(find_entry(name, self.root), self.full, self.data, self.device):
                    sys.stdout.write(f"  {check}\n")
                    failed += not check.passed
            except NmpmError as error:
                if self.name is not None:
                    raise
                if isinstance(error, ConfigError):
                    sys.stdout.write(f"  not verified: {error}\n")
                    left_out.append(name)
                else:
                    sys.stdout.write(f"  FAIL  {error}\n")
                    failed += 1
        sys.stdout.write(f"{failed} figures are not confirmed." if failed else "All that was measured is confirmed.")
        sys.stdout.write(f" Not verified: {', '.join(left_out)}.\n" if left_out else "\n")
        return 1 if failed else 0


@dataclass(frozen=True, kw_only=True)
class Refresh(_ZooCommand, DeviceOptions):
    """Write READMEs, charts and the table of --root's models again.

    Args:
        name: Name of your own, or an entry's folder (default: every model).
        measure: For the cards: speed (on this machine), quality (earth mover's distance, energy, shape, worst scene),
            ensemble (scores of eight members), twin and floor (the simulator beside itself), trust (by valid scenes),
            stress; invariants: the stress tests without the simulator, where its scenes would take hours.
        data: NAME's data; spares simulating its scenes.
        failures: What is wrong in NAME's pictures, for its card ("": nothing is known).
        device: Where the speed is measured: auto, cpu, cuda or mps; cuda:1 for the second GPU.
    """

    name: str | None = positional()
    measure: list[str] = option((), metavar="WHAT")
    data: Path | None = option(metavar="FOLDER")
    failures: str | None = option(metavar="TEXT")

    def run(self) -> None:
        from nmpm.zoo.registry import Zoo, find_writable

        _check_one("--data is the folder of one model's data", self.data, self.name)
        _check_one("--failures is about one model", self.failures, self.name)
        root = user_zoo() if self.root is None else self.root
        names = Zoo.list(root) if self.name is None else [self.name]
        folders = [find_writable(name, self.root) for name in names]
        from nmpm.zoo.refresh import refresh, write_index  # imports torch

        for folder in folders:
            refresh(folder, self.measure, self.data, self.failures, self.device)
            sys.stdout.write(f"wrote {folder}\n")
        if all(folder.resolve().is_relative_to(root.resolve()) for folder in folders):
            sys.stdout.write(f"wrote {write_index(root)}\n")


def _check_one(option: str, value: object, name: str | None) -> None:
    """Make sure that an option about one model comes with its name."""
    if value is not None and name is None:
        raise ConfigError(f"{option}: give the model's NAME too.")


@dataclass(frozen=True, kw_only=True)
class Push(_ZooCommand):
    """Upload a model to the Hugging Face hub.

    Args:
        repository: Owner/repository, created if missing.
        private: Refuse a public repository; make a new one private.
    """

    name: str
    repository: str
    private: bool = False

    def run(self) -> None:
        from nmpm.zoo.hub import push
        from nmpm.zoo.registry import find_entry

        commit = push(find_entry(self.name, self.root), self.repository, self.private)
        sys.stdout.write(f"pushed {commit}; load it by that id.\n")


@dataclass(frozen=True, kw_only=True)
class Pull(_ZooCommand):
    """Download a model of the Hugging Face hub.

    Args:
        id: owner/repository@revision; a commit always means the same files.
        name: Name of a new entry of your own zoo, or of --root (default: none).
    """

    id: str
    name: str | None = positional()

    def run(self) -> None:
        from nmpm.zoo.hub import HubId, download, pull

        identifier = HubId.parse(self.id)
        if identifier is None:
            raise ConfigError(f"{self.id} is not owner/repository@revision; the revision may be a commit, or main.")
        from nmpm.zoo.entries import load_entry  # imports torch
        from nmpm.zoo.publish import new_entry_folder

        if self.name is None:
            folder = download(identifier)
            load_entry(folder)
        else:
            folder = pull(identifier, new_entry_folder(self.name, self.root), self.name)
        sys.stdout.write(f"{identifier} is in {folder}\n")


class ZooCommands(Command):
    """List the pretrained models, find one for your data, or add a finished run.

    Examples:
        nmpm zoo list                            names, states, errors and data
        nmpm zoo card goop                       errors, times, training and known failures of one
        nmpm zoo match grains                    which model to use, or to start from, for your own data
        nmpm zoo verify goop                     are the card's figures true here?
        nmpm zoo add runs/goop goop/mine --about "goop with a longer training"
        nmpm zoo push goop/mine me/goop          upload it, for nmpm zoo pull me/goop@main
    """

    commands: ClassVar[Mapping[str, type[Command]]] = {
        "list": List,
        "card": Card,
        "match": MatchModels,
        "add": Add,
        "verify": Verify,
        "refresh": Refresh,
        "push": Push,
        "pull": Pull,
    }
