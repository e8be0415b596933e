"""What the configuration of a run may name without being asked for, as runs are shared: classes that nmpm ships, and
those of torch and Lightning that its own runs use. Nothing is imported here.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any

from nmpm._support.messages import one_line
from nmpm._support.shipped import PACKAGE

OPTION = "--trust-config"
NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+")
_OPTIMIZER = re.compile(r"torch\.optim(\.lr_scheduler)?\.(?!LambdaLR|MultiplicativeLR)[A-Z]\w*")
_LIGHTNING = re.compile(
    r"(lightning\.pytorch|pytorch_lightning)\.(loggers\.(CSVLogger|TensorBoardLogger)|callbacks\.(BatchSizeFinder"
    r"|DeviceStatsMonitor|EMAWeightAveraging|EarlyStopping|GradientAccumulationScheduler|LearningRateFinder"
    r"|LearningRateMonitor|ModelCheckpoint|ModelSummary|RichModelSummary|RichProgressBar|StochasticWeightAveraging"
    r"|TQDMProgressBar|Timer|WeightAveraging))"
)
_OBJECTS = ("callbacks", "logger", "plugins")
"""Keys of the trainer whose values are objects, also where they are texts."""


def foreign_names(content: Any, trusted: Collection[str] = ()) -> list[str]:
    """What a configuration names that is neither known nor trusted: classes, functions, references that hide names."""
    return [name for key, name in _texts(content, "") if name not in trusted and _is_foreign(key, name)]


def trust_advice(name: str) -> str:
    """The end of an error about such a name."""
    return f"names {one_line(name, 80)}, which is not of nmpm and would be run. If you trust it, add {OPTION}."


def _texts(content: Any, key: str) -> Iterator[tuple[str, str]]:
    """Yields all texts, each with the last key above it."""
    if isinstance(content, Mapping):
        for inner, value in content.items():
            yield from _texts(value, str(inner).rpartition(".")[2])
    elif isinstance(content, list | tuple):
        for value in content:
            yield from _texts(value, key)
    elif isinstance(content, str):
        yield key, content


def _is_foreign(key: str, text: str) -> bool:
    text = text.strip()
    if "${" in text:
        return True
    if key == "class_path" or (key in _OBJECTS and text.lower() not in ("true", "false", "null", "")):
        return not _is_known(text)
    return bool(NAME.fullmatch(text)) and not _is_known(text) and _is_importable(text.partition(".")[0])


def _is_known(name: str) -> bool:
    return bool(_OPTIMIZER.fullmatch(name) or _LIGHTNING.fullmatch(name)) or _is_shipped(name) or _is_of_plugin(name)


def _is_shipped(name: str) -> bool:
    """Whether a module of nmpm, or one of a package's modules, defines a class of this name."""
    module, _, kind = name.rpartition(".")
    if not NAME.fullmatch(name) or module.partition(".")[0] != "nmpm":
        return False
    path = PACKAGE.parent.joinpath(*module.split("."))
    files = [*path.rglob("*.py"), path.with_suffix(".py")]
    definition = re.compile(rf"^class {kind}\b", re.MULTILINE)
    return any(definition.search(file.read_text(encoding="utf-8")) for file in files if file.is_file())


def _is_of_plugin(name: str) -> bool:
    roots = {entry.value.partition(":")[0].partition(".")[0] for entry in entry_points(group="nmpm.plugins")}
    return name.partition(".")[0] in roots


def _is_importable(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except (ImportError, ValueError):
        return False
