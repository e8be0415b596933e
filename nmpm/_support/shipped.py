"""What ships with the package: configurations and zoo, in the wheel and in a clone alike."""

from __future__ import annotations

from pathlib import Path

from nmpm.errors import ConfigError


def shipped(folder: str) -> Path:
    """The shipped folder `configs` or `zoo`: inside the installed package, or beside it in a clone."""
    package = Path(__file__).parents[1]
    installed = package / "_shipped" / folder
    return installed if installed.is_dir() else package.parent / folder


def config_names() -> list[str]:
    """Names of the shipped configurations, as `--config` takes them."""
    root = shipped("configs")
    return sorted(str(path.relative_to(root)) for path in root.rglob("*.yaml"))


def find_config(name: str) -> Path:
    """The configuration file that a `--config` means: a file that exists, else the shipped one of that name.

    Raises:
        ConfigError: if there is neither.
    """
    given = Path(name)
    if given.is_file():
        return given
    if name in config_names():
        return shipped("configs") / name
    raise ConfigError(
        f"--config {name}: there is no such file here, and the shipped configurations are {', '.join(config_names())}."
    )
