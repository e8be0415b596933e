"""Which of a model's materials each material of foreign data is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from nmpm._support.messages import suggestion
from nmpm.errors import ConfigError

_WORDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "sand": ("grain", "granul", "gravel", "soil", "powder"),
        "water": ("fluid", "liquid"),
        "goop": ("jelly", "snow", "elastic"),
    }
)
"""Parts of other programs' names for the materials of the zoo."""


@dataclass(frozen=True)
class MaterialNames:
    """The model's material by the data's name, and why.

    Args:
        names: For every material of the data.
        note: How they were told, where the names are not the same.
    """

    names: Mapping[str, str]
    note: str = ""

    def __str__(self) -> str:
        groups = {theirs: [name for name, to in self.names.items() if to == theirs] for theirs in self.names.values()}
        return "; ".join(f"{', '.join(names)} -> {theirs}" for theirs, names in groups.items()) + self.note


def match_materials(
    model: Sequence[str], data: Sequence[str], given: Mapping[str, str], sides: tuple[str, str]
) -> MaterialNames:
    """The model's material for each of the data.

    Those that are not given are told by the same name, then by a part of it or a word for it; a model of one material
    takes everything.

    Args:
        model: Names of the model's materials.
        data: Names of the data's.
        given: The model's name by the data's, as the user states it.
        sides: Names of model and data, for messages.

    Raises:
        ConfigError: if a given name is on neither side, or a material of the data cannot be told.
    """
    _check_given(model, data, given, sides)
    names = {name: given.get(name) or _told(name, model) for name in data}
    if len(model) == 1:
        guesses = [name for name in data if names[name] is None]
        names.update(dict.fromkeys(guesses, model[0]))
    unknown = [name for name in data if names[name] is None]
    if unknown:
        raise ConfigError(
            f"{sides[1]} has {', '.join(data)}; {sides[0]} has {', '.join(model)}. State which is which: --materials"
            f" {','.join(f'{name}={names[name] or model[0]}' for name in data)} (in Python materials={{"
            f"{unknown[0]!r}: {model[0]!r}, …}})."
        )
    resolved = {name: str(to) for name, to in names.items()}
    proposed = [name for name, to in resolved.items() if name not in given and name.casefold() != to.casefold()]
    only = f" (the only material of {sides[0]})" if len(model) == 1 else " (proposed from the names)"
    return MaterialNames(resolved, only if proposed else "")


def _check_given(model: Sequence[str], data: Sequence[str], given: Mapping[str, str], sides: tuple[str, str]) -> None:
    for names, side, others in ((given, sides[1], data), (given.values(), sides[0], model)):
        for name in names:
            if name not in others:
                raise ConfigError(
                    f"materials: {side} has no {name!r} but {', '.join(others)}.{suggestion(name, others)}"
                    " Give the data's name first: --materials big=sand."
                )


def _told(name: str, model: Sequence[str]) -> str | None:
    """The model's material that a name means; None if that cannot be told, or could be two."""
    if name in model:
        return name
    plain = name.casefold()
    same = [theirs for theirs in model if theirs.casefold() == plain]
    near = [
        theirs
        for theirs in model
        if any(word in plain for word in (theirs.casefold(), *_WORDS.get(theirs.casefold(), ())))
    ]
    return next(iter(same or near), None) if len(same or near) == 1 else None
