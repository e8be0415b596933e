"""The frame of commands: a frozen dataclass of options, whose fields and docstring make the parser, the help and Tab.

A field without default is a positional argument, a field by `positional(default)` one that may be left out; every other
field is an option: `trust_config` is `--trust-config`. Texts about them are the section "Args:" of the docstring, its
section "Examples:" ends the help. Groups of options that several commands share are base classes (`nmpm.cli.options`).
Checks that a field's `Annotated` type has run when the command is made, from words or in Python:
`View(file=path).run()`. A field whose metadata have a `text` (`nmpm.data.stated.Text`) is read and written by it.
"""

from __future__ import annotations

import argparse
import inspect
import re
import shutil
import sys
import textwrap
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from difflib import get_close_matches
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

from jsonargparse import ArgumentParser

from nmpm._support.messages import one_line
from nmpm.errors import NmpmError

LONGEST = 300
"""Characters of a message of jsonargparse's that are shown."""
_UNKNOWN = (
    (r"unrecognized arguments: --([\w.-]+)", "there is no option {}", "--"),
    (r"Subcommand '\w+' does not accept option '([\w.]+)'", "the configuration has an unknown key {}", ""),
    (r"Option '([\w.]+)' is not accepted", "the argument {} is unknown", ""),
)
"""Messages about unknown names, what is said instead, and what is before the name of an option."""
_METAVARS = {int: "INTEGER", float: "NUMBER", Path: "PATH"}
"""What stands for a value of an option in the help."""


class UsageError(NmpmError):
    """An option or key that does not exist, or a value of the wrong type; the message is one line."""

    exit_status = 2


def positional(default: Any = None, metavar: str | None = None) -> Any:
    """A field that is a positional argument, which may be left out."""
    return field(default=default, metadata={"positional": True, "metavar": metavar})


def option(default: Any = None, metavar: str | None = None, **metadata: Any) -> Any:
    """A field that is an option, with what stands for its value in the help."""
    return field(default=default, metadata={"metavar": metavar, **metadata})


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command of `nmpm`, ready to run; its class is what the entry-point group "nmpm.commands" registers.

    Making one raises ConfigError for values that the checks of the fields' types refuse.
    """

    title: ClassVar[str] = "options"
    """Heading of the help for the options that the class declares."""
    commands: ClassVar[Mapping[str, type[Command]]] = {}
    """Commands of this one, such as those of `nmpm zoo`; it has no options then."""
    words: ClassVar[Sequence[str]] = ()
    """The words that state its values, if `run_words` has made it."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            if (value := getattr(self, name, None)) is not None:
                for check in _checks(hint):
                    check(label(self.__dataclass_fields__[name]), value)

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        """Texts that stand in the docstring for names in braces."""
        return {}

    def run(self) -> int | None:
        """Run the command; the exit status, of which None is 0."""
        raise NotImplementedError

    @classmethod
    def add_arguments(cls, parser: CommandParser) -> None:
        """Add arguments that are no fields to the command's parser."""

    @classmethod
    def run_words(cls, prog: str, words: Sequence[str]) -> int | None:
        """Run the command that words state; the exit status, of which None is 0."""
        spelt = [re.sub(r"^--[a-z_]+", lambda name: name[0].replace("_", "-"), word) for word in words]
        values = vars(command_parser(cls, prog).parse_args(spelt))
        for one in fields(cls):
            if "text" in one.metadata:
                values[one.name] = one.metadata["text"].read(label(one), values[one.name])
        command = cls(**values)
        object.__setattr__(command, "words", words)
        return command.run()


def label(declared: Field[Any]) -> str:
    """How messages name a field: FILE, or --every."""
    if _is_positional(declared):
        return declared.name.upper()
    return declared.metadata.get("label") or f"--{declared.name.replace('_', '-')}"


def summary(kind: type[Command]) -> str:
    """The first line of a command's docstring."""
    return str(inspect.cleandoc(kind.__doc__ or "").partition("\n")[0])


def sections(kind: type) -> tuple[str, dict[str, str], str]:
    """The description, the texts about arguments, and the examples of a class's docstring."""
    text = inspect.cleandoc(kind.__doc__ or "")
    parts = re.split(r"^([A-Z][a-z]+):\n(?= )", text, flags=re.MULTILINE)
    indented = ["\n".join(takewhile(lambda line: line[:1] in ("", " "), part.splitlines())) for part in parts[2::2]]
    named = dict(zip(parts[1::2], map(textwrap.dedent, indented), strict=True))
    entries = re.split(r"\n(?=\w+: )", named.get("Args", "").strip("\n"))
    texts = [entry.partition(": ") for entry in entries]
    return parts[0].strip(), {name: " ".join(text.split()) for name, _, text in texts}, named.get("Examples", "")


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help with prose that is filled to the terminal's width; paragraphs of examples stay as written."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = re.split(r"\n{2,}", text.strip("\n"))
        filled = [one if "\n " in one or one.startswith(" ") else textwrap.fill(one, width) for one in paragraphs]
        return textwrap.indent("\n\n".join(filled), indent) + "\n"


class CommandParser(ArgumentParser):
    """A command's parser, whose errors are one line.

    Args:
        parts: Names of options by the argument of a part that each sets; set by `Command.add_arguments`.
    """

    parts: Mapping[str, str] = MappingProxyType({})

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Raise UsageError with the nearest option, and with where the options are."""
        names = [name.removeprefix("--") for name in self._option_string_actions if name.startswith("--")]
        line = explain(message, names, self.parts).rstrip(".")
        raise UsageError(f"{line}{'' if line.endswith('?') else '.'} See {self.prog} --help.") from ex


def command_parser(kind: type[Command], prog: str) -> CommandParser:
    """The parser of a command's options, those of its own before those of its base classes."""
    description, _, examples = sections(kind)
    if kind.commands:
        columns = shutil.get_terminal_size().columns - 2  # as argparse
        lines = [
            textwrap.fill(summary(command), columns, initial_indent=f"  {name:<8} ", subsequent_indent=" " * 11)
            for name, command in kind.commands.items()
        ]
        description += "\n\ncommands:\n" + "\n".join(lines)
    values = kind.help_values()
    if values:
        description, examples = description.format(**values), examples.format(**values)
    # Calls are indented below their heading, prose between them is not.
    paragraphs = re.split(r"\n{2,}", examples.strip("\n"))
    shown = "\n\n".join(textwrap.indent(one, "  ") if one.startswith("nmpm ") else one for one in paragraphs)
    epilog = f"examples:\n{shown}" if examples else ""
    parser = CommandParser(
        prog=prog, description=description, epilog=epilog, formatter_class=HelpFormatter, allow_abbrev=True
    )
    hints, texts = get_type_hints(kind), argument_texts(kind)
    groups: dict[str, Any] = {"options": parser}
    for title, declared in _by_class(kind):
        group = groups.get(title) or groups.setdefault(title, parser.add_argument_group(title))
        for one in declared:
            text = texts[one.name].format(**values) if values else texts[one.name]
            _add_argument(parser if _is_positional(one) else group, one, hints[one.name], text)
    kind.add_arguments(parser)
    return parser


def run_command(kind: type[Command], prog: str, words: Sequence[str]) -> int | None:
    """Run the command that words state; the exit status.

    Raises:
        UsageError: for what the parser refuses.
        NmpmError: for what checks refuse, or the command.
    """
    if kind.commands:
        index = next((index for index, word in enumerate(words) if word in kind.commands), None)
        if index is not None:  # options may be before the name
            return run_command(
                kind.commands[words[index]], f"{prog} {words[index]}", [*words[:index], *words[index + 1 :]]
            )
        if not words:
            command_parser(kind, prog).print_help(sys.stderr)
            return 2
        if unknown := next((word for word in words if not word.startswith("-")), None):
            near = get_close_matches(unknown, kind.commands, n=1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(kind.commands)}."
            raise UsageError(f"there is no command {one_line(repr(unknown), 60)}; {hint} See {prog} --help.")
    return kind.run_words(prog, words)


def _by_class(kind: type[Command]) -> Iterator[tuple[str, list[Field[Any]]]]:
    """Fields by the heading of the class that declares them first, those of the command itself in front."""
    left = {one.name: one for one in fields(kind)}
    for owner in kind.__mro__:
        declared = [left.pop(name) for name in inspect.get_annotations(owner) if name in left]
        if declared:
            yield vars(owner).get("title", "options"), declared


def argument_texts(kind: type[Command]) -> dict[str, str]:
    """The help of each field, of the nearest class whose docstring has it."""
    texts: dict[str, str] = {}
    for owner in kind.__mro__:
        texts = sections(owner)[1] | texts
    return texts


def _add_argument(parser: Any, declared: Field[Any], hint: Any, text: str) -> None:
    """Add an argument for a field."""
    hint = _without_none(hint)
    default = None if declared.default is MISSING else declared.default
    metavar = declared.metadata.get("metavar")
    settings: dict[str, Any] = {"default": default}
    if "text" in declared.metadata:
        hint = str
    if hint is bool:
        settings["action"] = "store_true"
    elif get_origin(hint) is Literal:
        settings["choices"] = get_args(hint)
    elif get_origin(hint) in (list, tuple):
        settings |= {
            "nargs": declared.metadata.get("nargs", "+"),
            "type": get_args(hint)[0],
            "metavar": metavar or declared.name.upper(),
        }
    else:
        settings |= {"type": hint, "metavar": metavar or _METAVARS.get(hint, declared.name.upper())}
    if _is_positional(declared):
        settings["metavar"] = metavar or declared.name
        if declared.default is not MISSING:
            settings["nargs"] = "*" if "nargs" in settings else "?"
        else:
            settings.pop("default")
    if default not in (None, False, "", ()) and "default" not in text:
        text = f"{text.rstrip('.')} (default: {default})"
    name = declared.name if _is_positional(declared) else label(declared)
    parser.add_argument(name, help=text.replace("%", "%%"), **settings)


def _checks(hint: Any) -> Iterator[Callable[[str, Any], None]]:
    """The checks of a type, which may be one of several."""
    if get_origin(hint) is Annotated:
        yield from hint.__metadata__
    elif get_origin(hint) in (Union, types.UnionType):
        for inner in get_args(hint):
            yield from _checks(inner)


def _without_none(hint: Any) -> Any:
    """A type without None, which stands for an option that is not given."""
    if get_origin(hint) in (Union, types.UnionType):
        (hint,) = (one for one in get_args(hint) if one is not type(None))
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _is_positional(declared: Field[Any]) -> bool:
    return declared.default is MISSING or bool(declared.metadata.get("positional"))


def nearest(wrong: str, names: Iterable[str], parts: Mapping[str, str], mark: str) -> str:
    """The end of a sentence about a wrong name: whether the nearest is meant, else one whose last word is near."""
    names = list(names)
    near = get_close_matches(wrong, names, n=1, cutoff=0.8)
    if not near:
        last = {name.rpartition(".")[2]: name for name in names} | dict(parts)
        near = [last[word] for word in get_close_matches(wrong.rpartition(".")[2], last, n=1, cutoff=0.75)]
    return f"; did you mean {mark}{near[0]}?" if near else "."


def explain(message: str, names: Iterable[str] = (), parts: Mapping[str, str] = MappingProxyType({})) -> str:
    """A message of argparse or jsonargparse in one line, which asks for the name that is like an unknown one."""
    for pattern, sentence, mark in _UNKNOWN:
        if match := re.match(pattern, message):
            return sentence.format(f"{mark}{match[1]}") + nearest(match[1], names, parts, mark)
    key = re.match(r'Parser key "([\w.]+)"(?: element \d+)?:', message)
    option = f"--{key[1]}: " if key else ""
    if match := re.search(r"module '([\w.]+)' has no attribute '(\w+)'", message):
        public = [name for name in vars(sys.modules.get(match[1], object())) if not name.startswith("_")]
        near = get_close_matches(match[2], public, n=1)
        question = f"; did you mean {match[1]}.{near[0]}?" if near else "."
        return f"{option}there is no {match[1]}.{match[2]}{question}"
    if match := re.search(r"Expected a <class '(\w+)'>\.? Got value: (.*)", message):
        return f"{option}{match[2]} is not of type {match[1]}."
    if match := re.search(r"Expected a typing\.Literal\[(.*?)\]\.? Got value: (\S+)", message):
        return f"{option}{match[2]} is not one of {match[1]}."
    if match := re.search(r"Problem with given class_path '([\w.]+)':\s+(.+)", message):
        return f"{match[1]}: {match[2]}"
    rest = re.sub(r"- Expected a path but \S+ either not accessible or invalid", "", message[key.end() if key else 0 :])
    return option + one_line(rest.strip().removeprefix("- "), LONGEST)
