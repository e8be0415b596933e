"""What a page sends: one JSON object a message, checked before anything happens."""

from __future__ import annotations

import json
from collections.abc import Mapping
from types import MappingProxyType

from nmpm._support.messages import one_line, suggestion
from nmpm._support.plain_data import from_plain
from nmpm.errors import ConfigError
from nmpm.play import commands
from nmpm.play.commands import Command

COMMANDS: Mapping[str, type[Command]] = MappingProxyType(
    {
        "throw": commands.Throw,
        "pour": commands.Pour,
        "stop": commands.StopPouring,
        "move": commands.Move,
        "put": commands.Put,
        "remove": commands.Remove,
        "gravity": commands.Gravity,
        "play": commands.Play,
        "step": commands.Step,
        "pace": commands.Pace,
        "restart": commands.Restart,
        "beside": commands.Beside,
        "save": commands.Save,
        "seen": commands.Seen,
    }
)
"""Classes of commands by the value of `do`; their fields are the message's other keys."""

MOST_BYTES = 1000
"""Longest message."""


def read_command(message: str | bytes) -> Command:
    """The command of a message.

    Raises:
        ConfigError: if it is none, or a value is of the wrong kind or not finite.
    """
    if len(message) > MOST_BYTES:
        raise ConfigError(f"the message has {len(message)} characters; at most {MOST_BYTES} are read")
    try:
        plain = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"the message is no JSON: {one_line(error, 80)}") from error
    if not isinstance(plain, dict) or not isinstance(plain.get("do"), str):
        raise ConfigError('the message has no "do"')
    name = plain.pop("do")
    if name not in COMMANDS:
        raise ConfigError(f"there is no {one_line(repr(name), 40)}.{suggestion(name[:40], COMMANDS)}")
    return from_plain(COMMANDS[name], plain, name)
