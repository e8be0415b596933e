"""Which of a model's materials each material of foreign data is."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
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


def match_materials(
    model: Sequence[str], data: Sequence[str], given: Mapping[str, str], sides: tuple[str, str]
) -> dict[str, str]:
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
    _check_given(given, sides[1], data)
    _check_given(given.values(), sides[0], model)
    only = model[0] if len(model) == 1 else None
    names = {name: given.get(name) or _told(name, model) or only for name in data}
    unknown = [name for name, to in names.items() if to is None]
    if unknown:
        raise ConfigError(
            f"{sides[1]} has {', '.join(data)}; {sides[0]} has {', '.join(model)}. State which is which: --materials"
            f" {','.join(f'{name}={to or model[0]}' for name, to in names.items())} (in Python materials={{"
            f"{unknown[0]!r}: {model[0]!r}, …}})."
        )
    return {name: str(to) for name, to in names.items()}


def describe_materials(names: Mapping[str, str], model: Sequence[str], given: Container[str], side: str) -> str:
    """What `match_materials` gives in words, such as "big, small -> sand (proposed from the names)"."""
    groups = {theirs: [name for name, to in names.items() if to == theirs] for theirs in names.values()}
    text = "; ".join(f"{', '.join(of_data)} -> {theirs}" for theirs, of_data in groups.items())
    if all(name in given or name.casefold() == to.casefold() for name, to in names.items()):
        return text
    return f"{text} (the only material of {side})" if len(model) == 1 else f"{text} (proposed from the names)"


def _check_given(given: Iterable[str], side: str, names: Sequence[str]) -> None:
    for name in given:
        if name not in names:
            raise ConfigError(
                f"materials: {side} has no {name!r} but {', '.join(names)}.{suggestion(name, names)}"
                " Give the data's name first: --materials big=sand."
            )


def _told(name: str, model: Sequence[str]) -> str | None:
    """The model's material that a name means; None if that cannot be told, or could be two."""
    if name in model:
        return name
    plain, words = name.casefold(), {theirs: theirs.casefold() for theirs in model}
    same = [theirs for theirs, word in words.items() if word == plain]
    near = [theirs for theirs, word in words.items() if any(part in plain for part in (word, *_WORDS.get(word, ())))]
    candidates = same or near
    return candidates[0] if len(candidates) == 1 else None
