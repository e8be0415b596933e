"""Files that ship with the package, configurations and zoo, and the user's own folder beside them."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from nmpm._support.messages import suggestion
from nmpm.errors import ConfigError, DataError
from nmpm.registry import Registry

PACKAGE = Path(__file__).parents[1]
"""The folder of the package."""
SCENES: Registry[Path] = Registry(
    "nmpm.scenes",
    "scene",
    {path.stem: path for path in sorted((PACKAGE / "sim" / "presets").glob("*.yaml"), key=lambda file: file.stem)},
)
"""YAML files of the presets of simulators, by name; another package's entry point names a `Path`."""


def shipped_folder(folder: str) -> Path:
    """The shipped folder `configs` or `zoo`: inside the installed package, or beside it in a clone."""
    installed = PACKAGE / "_shipped" / folder
    return installed if installed.is_dir() else PACKAGE.parent / folder


def user_home() -> Path:
    """The user's folder of datasets and models: the environment variable `NMPM_HOME`, else `~/.cache/nmpm`.

    Users without a home folder, as in containers, have one of their number in the folder of temporary files.
    """
    given = os.environ.get("NMPM_HOME") or "~/.cache/nmpm"
    try:
        return Path(given).expanduser()
    except RuntimeError:  # no HOME, and no such user
        return Path(tempfile.gettempdir()) / f"nmpm-{os.getuid()}"


def user_zoo() -> Path:
    """The folder of the user's own models."""
    return user_home() / "zoo"


def entry_names(zoo: Path) -> list[str]:
    """Names of the models in the folder of a zoo, such as "goop" or "goop/fast"."""
    cards = (*zoo.glob("*/card.yaml"), *zoo.glob("*/*/card.yaml"))
    return sorted(card.parent.relative_to(zoo).as_posix() for card in cards)


def preset_names() -> tuple[str, ...]:
    """Names of the presets of simulators, which are those of the embedded datasets."""
    return tuple(SCENES)


def check_dataset(name: str) -> None:
    """Raise DataError if no embedded dataset has the name."""
    if name not in SCENES:
        raise DataError(
            f"No embedded dataset is called {name!r}; known: {', '.join(SCENES)}.{suggestion(name, SCENES)} For"
            " your own data, give the path of their folder."
        )


def find_preset(name: str | Path) -> Path:
    """The file of a preset: the one of that name, else a file that exists; ConfigError if there is neither."""
    if str(name) in SCENES:
        return SCENES[str(name)]
    if Path(name).is_file():
        return Path(name)
    raise ConfigError(
        f"There is no preset or file {name}; presets: {', '.join(SCENES)}.{suggestion(str(name), SCENES)}"
    )


def config_names() -> list[str]:
    """Names of the shipped configurations, as `--config` takes them."""
    root = shipped_folder("configs")
    return sorted(str(path.relative_to(root)) for path in root.rglob("*.yaml"))


def find_config(name: str) -> Path:
    """The file that a `--config` means: one that exists, else the shipped one of that name; ConfigError if neither."""
    names = config_names()
    if Path(name).is_file():
        return Path(name)
    if name in names:
        return shipped_folder("configs") / name
    raise ConfigError(
        f"--config {name}: there is no such file here, and the shipped configurations are"
        f" {', '.join(names)}.{suggestion(name, names)}"
    )
