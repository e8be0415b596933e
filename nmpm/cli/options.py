"""Options and checks that several commands share."""

from __future__ import annotations

import argparse
import dataclasses
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from nmpm._support.atomic import file_obstacle, folder_obstacle, name_obstacle
from nmpm._support.devices import check_device_name, find_device
from nmpm._support.messages import one_line, suggestion
from nmpm._support.shipped import preset_names
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.convert import Options
    from nmpm.zoo import Pretrained

MODEL = (
    "a model of the zoo (see nmpm zoo list); a path: a run, a checkpoint, or an entry's folder; or an id of the Hugging"
    " Face hub, owner/repository@revision"
)
"""Help for arguments that `nmpm.zoo.load_model` takes."""


_TYPES = {int: "INTEGER", float: "NUMBER", Path: "PATH"}
"""What stands for a value of an option in the help."""


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help with types and defaults of options, and with prose filled to the terminal's width.

    Paragraphs with indented lines, as examples are, stay as written.
    """

    def _get_default_metavar_for_optional(self, action: argparse.Action) -> str:
        named = _TYPES.get(action.type) if isinstance(action.type, type) else None
        return named or super()._get_default_metavar_for_optional(action)

    def _get_help_string(self, action: argparse.Action) -> str | None:
        text = action.help or ""
        if not action.option_strings or "default" in text or action.default in (None, False, argparse.SUPPRESS, [], ""):
            return text
        return f"{text} (default: %(default)s)"

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = text.strip("\n").split("\n\n")
        filled = [
            paragraph if "\n " in paragraph or paragraph.startswith(" ") else textwrap.fill(paragraph, width)
            for paragraph in paragraphs
        ]
        return textwrap.indent("\n\n".join(filled), indent) + "\n"


class CommandParser(argparse.ArgumentParser):
    """A command's parser; an error is one line, and says where the options are."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **{"formatter_class": HelpFormatter} | options)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}. See {self.prog} --help.\n")


def add_model_options(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Add the positional argument `model`, which may be left out where there is a default, and the option `--root`."""
    if default is None:
        parser.add_argument("model", help=MODEL)
    else:
        parser.add_argument("model", nargs="?", default=default, help=f"{MODEL} (default: {default})")
    parser.add_argument("--root", type=Path, help="look the name up in this zoo's folder alone")


def add_device_option(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    """Add the option `--device`; `purpose` begins its help."""
    parser.add_argument(
        "--device", default="cpu", help=f"{purpose}auto, cpu (default), cuda or mps; cuda:1 for the second GPU"
    )


def add_style_option(parser: argparse.ArgumentParser, drawn: str) -> None:
    """Add the option `--style`, a key of `nmpm.viz.output.STYLES`; `drawn` begins its help."""
    parser.add_argument("--style", choices=("talk", "paper"), help=f"{drawn} for slides (SVG) or for print (PDF)")


def add_threads_option(parser: argparse.ArgumentParser) -> None:
    """Add the option `--threads`."""
    parser.add_argument(
        "--threads",
        type=int,
        help="of a CPU (default: OMP_NUM_THREADS; else the faster of one and all that may be used, as measured)",
    )


def choose_threads(model: Pretrained, stated: int | None) -> None:
    """Let a model's calls on a CPU use the threads that are stated, or the faster of one and all."""
    if model.emulator.device.type == "cpu":
        import torch

        from nmpm._support.threads import ThreadChoice, stated_threads

        choice = ThreadChoice(stated_threads(stated), torch.set_num_threads)
        torch.set_num_threads(choice.most)
        # Programs compiled for a number of threads would be compiled anew for another.
        model.emulator.thread_choice = None if model.emulator.runtime.fixed_shapes else choice


def add_runtime_option(parser: argparse.ArgumentParser) -> None:
    """Add the option `--runtime`."""
    parser.add_argument(
        "--runtime",
        default="eager",
        help="what computes the network: eager (torch, default), openvino (CPU, the extra of that name), windows (for"
        " large scenes that are mostly empty), or auto for the faster of eager and openvino here",
    )


RUNTIMES = ("auto", "openvino", "windows", "eager")
"""Values of `--runtime`; `nmpm.emulator.runtimes`, which imports torch, has them."""


def check_runtime(name: str) -> None:
    """Raise ConfigError if a `--runtime` does not exist; former names are accepted."""
    if name not in (*RUNTIMES, "cuda-graph", "triton"):
        raise ConfigError(
            f"No runtime is called {one_line(repr(name), 60)}; there are {', '.join(RUNTIMES)}."
            f"{suggestion(name[:60], RUNTIMES)}"
        )


def add_out_option(parser: argparse.ArgumentParser, default: Path) -> None:
    """Add the option `--out` of a file for one trajectory."""
    from nmpm.data.write import SUFFIXES

    parser.add_argument(
        "--out", type=Path, default=default, help=f"file to write, by its suffix: {SUFFIXES} (default: {default})"
    )


def add_split_option(parser: argparse.ArgumentParser, option: str) -> None:
    """Add the option `--split` of data that another option or argument names."""
    parser.add_argument(
        "--split", choices=["train", "valid", "test"], help=f"of {option}, if it has several (default: test)"
    )


def check_model(model: str, root: Path | None = None) -> None:
    """Raise ZooError, before torch is imported, if there is no such model; downloads nothing."""
    from nmpm.zoo.registry import locate_model

    locate_model(model, root)


def check_device(name: str) -> None:
    """Raise ConfigError if a `--device` cannot run rollouts, as torch's "meta", or this machine does not have it."""
    check_device_name(name)
    if name not in ("auto", "cpu"):  # which every machine has
        find_device(name)


def check_at_least(option: str, value: int | None, least: int) -> None:
    """Raise ConfigError if an integer option was given, but is too small."""
    if value is not None and value < least:
        raise ConfigError(f"{option} {value}: it must be at least {least}.")


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


def find_data(data: Path, split: str | None, index: int) -> Path:
    """The file or folder of data; of an embedded dataset the folder, simulated first if it lacks the trajectory."""
    from nmpm.data.catalog import ensure, find_simulated

    if data.exists():
        return data
    counts = {"train": 0, "valid": 0, "test": 0} | {split or "test": index + 1}
    simulated = find_simulated(str(data), index + 1) if split in (None, "test") else None
    return simulated or ensure(str(data), counts)


def derived_name(path: Path, suffix: str) -> Path:
    """A file's path with another suffix; of a folder, its name in the working directory."""
    return (Path(path.resolve().name) if path.is_dir() else path).with_suffix(suffix)


def add_data_options(parser: argparse.ArgumentParser) -> None:
    """Add options for facts that data files lack or state wrongly."""
    group = parser.add_argument_group("facts that the files lack or state wrongly")
    group.add_argument("--family", help="meaning of type ids: deepmind, lagrangebench or jax-sph")
    group.add_argument("--types", metavar="ID=NAME,...", help="names of particle types, e.g. 5=water,1=debris")
    group.add_argument("--static", metavar="ID,...", help='types that never move, e.g. 1,3; "none" where all move')
    group.add_argument("--prescribed", metavar="ID,...", help="obstacles that move as recorded, like a paddle, e.g. 2")
    group.add_argument("--bounds", metavar="LOW:HIGH,...", help="where particles may be, per axis, e.g. 0:1,0:0.5")
    group.add_argument("--dt", type=float, help="time between stored frames, in the data's unit")
    group.add_argument(
        "--gravity", metavar="X,Y[,Z]", help="acceleration in length/time², e.g. 0,-9.81, or --gravity=-9.81,0"
    )
    group.add_argument(
        "--boundary", metavar="KIND,...", help='"wall", "periodic" or "open" per axis, e.g. periodic,wall'
    )
    group.add_argument(
        "--axes", metavar="TND", help="positions are frames, particles, axes, though their first two look swapped"
    )
    changes = parser.add_argument_group("changes of positions")
    changes.add_argument("--resample", type=float, metavar="DT", help="interpolate to frames that are DT apart in time")
    changes.add_argument(
        "--smooth",
        type=int,
        metavar="FRAMES",
        help="of measured tracks: replace positions by local quadratic fits to so many frames, e.g. 5; errors are then"
        " against the smoothed tracks",
    )
    group.add_argument(
        "--files", metavar="PATTERN,...", help="names of the files to read, e.g. 'Fluid_*.vtk', where others lie beside"
    )
    group.add_argument("--fields", metavar="NAME,...", help="fields that are inputs of models, e.g. temperature")


def data_options(options: argparse.Namespace) -> Options:
    """The values of the options of `add_data_options`; raises ConfigError, naming the option that cannot be read."""
    from nmpm.data.convert import Options
    from nmpm.data.metadata import find_family

    if options.family is not None:
        find_family(options.family)
    return Options(
        family=options.family,
        types=parse_option("--types", options.types, _names, "ID=NAME pairs, e.g. 5=water,1=debris"),
        static=parse_option("--static", options.static, _ids, 'type ids, e.g. 1,3, or "none"'),
        prescribed=parse_option("--prescribed", options.prescribed, _ids, 'type ids, e.g. 2, or "none"'),
        bounds=parse_option("--bounds", options.bounds, _intervals, "LOW:HIGH for each axis, e.g. 0:1,0:0.5"),
        dt=options.dt,
        gravity=gravity_option(options.gravity),
        boundary=options.boundary and options.boundary.split(","),
        fields=parse_option("--fields", options.fields, _field_names, "names, e.g. temperature,stiffness"),
        resample=options.resample,
        smooth=options.smooth,
        axes=options.axes,
        files=options.files,
    )


def stated_facts(options: argparse.Namespace) -> list[str]:
    """The options of `add_data_options` that were given, with their values, as words of a command."""
    from nmpm.data.convert import Options

    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(Options)}
    return [f"--{name}={value}" for name, value in values.items() if value is not None]


def gravity_option(text: str | None) -> tuple[float, ...] | None:
    """The numbers of `--gravity`; raises ConfigError if they cannot be read."""
    numbers: tuple[float, ...] | None = parse_option(
        "--gravity", text, _numbers, "a number for each axis, e.g. 0,-9.81"
    )
    return numbers


def parse_option(option: str, text: str | None, parse: Callable[[str], Any], expected: str) -> Any:
    """The value of an option's text, None of None; raises ConfigError, saying what is expected, if it is no such."""
    if text is None:
        return None
    try:
        return parse(text)
    except ValueError as error:
        raise ConfigError(f"{option} {text}: give {expected}.") from error


def _names(text: str) -> dict[int, str]:
    pairs = [pair.split("=") for pair in text.split(",")]
    return {int(index): name.strip() for index, name in pairs}


def _ids(text: str) -> frozenset[int]:
    return frozenset() if text == "none" else frozenset(map(int, text.split(",")))


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split(",")))


def _intervals(text: str) -> tuple[tuple[float, float], ...]:
    pairs = [tuple(map(float, pair.split(":"))) for pair in text.split(",")]
    if any(len(pair) != 2 or not pair[0] < pair[1] for pair in pairs):
        raise ValueError(text)
    return tuple((pair[0], pair[1]) for pair in pairs)


def _field_names(text: str) -> tuple[str, ...]:
    from nmpm.scene import check_field_names

    names = tuple(name.strip() for name in text.split(","))
    check_field_names(names)
    return names
