"""Options and checks that several commands share."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

from nmpm._support.atomic import file_obstacle, folder_obstacle, name_obstacle
from nmpm._support.machine import check_device_name, find_device
from nmpm._support.messages import suggestion
from nmpm._support.shipped import find_preset, preset_names
from nmpm.backends import ENGINES, RUNTIMES, check_runtime
from nmpm.cli.command import Command, option
from nmpm.data.stated import Options, Text
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.emulator.similarity import Match
    from nmpm.zoo import Pretrained


def choose_threads(model: Pretrained, stated: int | None) -> None:
    """Let a model's calls on a CPU use the threads that are stated, or the faster of one and all."""
    if model.emulator.device.type == "cpu":
        import torch

        from nmpm._support.threads import ThreadChoice, stated_threads

        choice = ThreadChoice(stated_threads(stated), torch.set_num_threads)
        torch.set_num_threads(choice.most)
        # Programs compiled for a number of threads would be compiled anew for another.
        model.emulator.thread_choice = None if model.emulator.runtime.fixed_shapes else choice


def check_model(model: str, root: Path | None = None) -> None:
    """Raise ZooError, before torch is imported, if there is no such model; downloads nothing."""
    from nmpm.zoo.registry import locate_model

    locate_model(model, root)


def check_device(name: str) -> None:
    """Raise ConfigError if a `--device` cannot run rollouts, as torch's "meta", or this machine does not have it."""
    check_device_name(name)
    if name not in ("auto", "cpu"):  # which every machine has
        find_device(name)


def check_output(option: str, path: Path) -> None:
    """Raise ConfigError, before the work, if a file cannot be written."""
    if obstacle := file_obstacle(path):
        raise ConfigError(f"{option} {path}: {obstacle}")


def check_picture(option: str, path: Path) -> None:
    """Raise ConfigError, before the work, if a file cannot be written, or its name does not end in .png."""
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{option} {path}: pictures are PNG; end the name in .png.")
    check_output(option, path)


def check_folder(option: str, path: Path) -> None:
    """Raise ConfigError, before the work, if a folder cannot be written or made."""
    if not (obstacle := name_obstacle(path)):
        existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
        if path.exists() and not path.is_dir():
            obstacle = "it is a file; name a folder."
        elif not existing.is_dir():
            obstacle = f"{existing} is a file, not a folder."
        else:
            obstacle = folder_obstacle(existing)
    if obstacle:
        raise ConfigError(f"{option} {path}: {obstacle}")


def check_input(option: str, path: Path) -> None:
    """Raise ConfigError if a file does not exist, or is a folder."""
    check_exists(option, path)
    if path.is_dir():
        raise ConfigError(f"{option} {path}: it is a folder; name a file in it.")


def check_exists(option: str, path: Path) -> None:
    """Raise ConfigError if there is no such file or folder."""
    if obstacle := name_obstacle(path) or ("" if path.exists() else "there is no such file or folder."):
        raise ConfigError(f"{option} {path}: {obstacle}")


def check_data(option: str, data: Path) -> None:
    """Raise ConfigError if data are neither a file or folder nor an embedded dataset."""
    names = preset_names()
    if not data.exists() and str(data) not in names:
        known = f"there is no such file or folder, nor an embedded dataset of that name: {', '.join(names)}."
        raise ConfigError(f"{option} {data}: {name_obstacle(data) or known + suggestion(str(data), names)}")


def derived_name(path: Path, suffix: str) -> Path:
    """A file's path with another suffix; of a folder, its name in the working directory."""
    return (Path(path.resolve().name) if path.is_dir() else path).with_suffix(suffix)


# Types of options, with their checks, and groups of options that several commands share


@dataclass(frozen=True)
class AtLeast:
    """Check of an integer."""

    least: int

    def __call__(self, option: str, value: int) -> None:
        """Raise ConfigError for a smaller value."""
        if value < self.least:
            raise ConfigError(f"{option} {value}: it must be at least {self.least}.")


def _check_trajectory_file(option: str, path: Path) -> None:
    from nmpm.data.write import find_writer

    find_writer(option, path)


Natural = Annotated[int, AtLeast(0)]
Positive = Annotated[int, AtLeast(1)]
Existing = Annotated[Path, check_exists]
ExistingFile = Annotated[Path, check_input]
OutputFile = Annotated[Path, check_output]
OutputFolder = Annotated[Path, check_folder]
Picture = Annotated[Path, check_picture]
TrajectoryFile = Annotated[Path, _check_trajectory_file]
Data = Annotated[Path, check_data]
Device = Annotated[str, lambda _, name: check_device(name)]
Runtime = Annotated[str, lambda _, name: check_runtime(name)]
PresetName = Annotated[str, lambda _, name: find_preset(name)]
SplitName = Literal["train", "valid", "test"]
Style = Literal["talk", "paper"]


@dataclass(frozen=True, kw_only=True)
class ModelOptions(Command):
    """The model.

    Args:
        model: A model of the zoo (see nmpm zoo list); a path: a run, a checkpoint, or an entry's folder; or an id of
            the Hugging Face hub, owner/repository@revision.
        root: Look the name up in this zoo's folder alone.
    """

    model: str
    root: Path | None = None

    def __post_init__(self) -> None:
        check_model(self.model, self.root)  # a device's check may import torch
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class DeviceOptions(Command):
    """Where to compute.

    Args:
        device: auto, cpu, cuda or mps; cuda:1 for the second GPU.
    """

    device: Device = "cpu"


@dataclass(frozen=True, kw_only=True)
class ThreadsOptions(Command):
    """Threads of a CPU.

    Args:
        threads: Of a CPU (default: OMP_NUM_THREADS; else the faster of one and all that may be used, as measured).
    """

    threads: Positive | None = None


@dataclass(frozen=True, kw_only=True)
class RuntimeOptions(Command):
    """What computes the network.

    Args:
        runtime: What computes the network: eager (torch, default), openvino (CPU, the extra of that name), windows
            (for large scenes that are mostly empty){further}, or auto for the faster of eager and openvino here (in
            rollout, of windows, too); or the engine that computes all else: {engines}.
    """

    runtime: Runtime = "eager"

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        return {"further": "".join(f", {name}" for name in RUNTIMES.plugins), "engines": ", ".join(ENGINES)}


@dataclass(frozen=True, kw_only=True)
class FactOptions(Options, Command):
    """Facts that data files lack or state wrongly."""

    def __post_init__(self) -> None:
        Command.__post_init__(self)
        Options.__post_init__(self)

    @property
    def facts(self) -> Options:
        """The facts alone."""
        return Options(**{one.name: getattr(self, one.name) for one in dataclasses.fields(Options)})


def _pairs(text: str) -> dict[str, str]:
    pairs = [[name.strip() for name in pair.split("=")] for pair in text.split(",")]
    if any(len(pair) != 2 or not all(pair) for pair in pairs):
        raise ValueError(text)
    renamed = dict(pairs)
    if len(renamed) < len(pairs):
        raise ValueError(text)
    return renamed


def _stride(text: str) -> Fraction:
    if not re.fullmatch(r"(1/)?0*[1-9][0-9]*", text):
        raise ValueError(text)
    return Fraction(text)


MATERIALS = Text(_pairs, "DATA=MODEL pairs of names, e.g. big=sand,small=sand")
STRIDE = Text(_stride, "a whole number of the data's frames, e.g. 2, or a part, 1/4")


class MatchOptions(NamedTuple):
    """Arguments of `nmpm.emulator.similarity.find_match` that a user states; what is None is found there."""

    materials: Mapping[str, str] | None = None
    stride: Fraction | None = None
    strict: bool = False


@dataclass(frozen=True, kw_only=True)
class ReadingOptions(Command):
    """How a model reads data of another kind than its own.

    Args:
        materials: Names of the data's materials, each with the model's material that it is, e.g. big=sand,small=sand.
        stride: Frames of the data for one of the model, e.g. 2; or 1/4, where the model makes four of one (default:
            what matches gravity best, or else speeds).
    """

    title: ClassVar[str] = "data of another kind than the model's"
    materials: Annotated[str, MATERIALS] | None = option(metavar="DATA=MODEL,...")
    stride: Annotated[str, STRIDE] | None = option(metavar="K")

    @property
    def match(self) -> MatchOptions:
        """What is stated, as `nmpm.zoo.matching.match_data` takes it."""
        return MatchOptions(
            MATERIALS.read("--materials", self.materials),
            STRIDE.read("--stride", self.stride),
            getattr(self, "strict", False),
        )


@dataclass(frozen=True, kw_only=True)
class StrictReadingOptions(ReadingOptions):
    """How a model reads data of another kind than its own, or that it shall not.

    Args:
        strict: Refuse data that are not of the model's kind in gravity, frames, particles, speeds or walls.
    """

    title: ClassVar[str] = ReadingOptions.title
    strict: bool = False


def describe(match: Match, name: str) -> str:
    """How the model of a name takes data, and what could not be matched, in lines."""
    lines = [f"{name} takes these data as follows.", *(f"  {line}" for line in match.lines)]
    return "".join(f"{line}\n" for line in (*lines, *(f"warning: {warning}" for warning in match.warnings)))
