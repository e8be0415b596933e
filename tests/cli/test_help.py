"""The help of every command teaches: it has examples, and fits on a terminal of 100 columns."""

import re
from contextlib import suppress

import pytest

from nmpm.cli import COMMANDS, main, usage

WIDTH = 100


def help_of(words, capsys) -> str:
    with suppress(SystemExit):
        main([*words, "--help"])
    said = capsys.readouterr()
    assert not said.err
    return said.out


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", str(WIDTH))


@pytest.mark.parametrize("command", [*COMMANDS, *(f"zoo {name}" for name in COMMANDS["zoo"].commands)])
def test_the_help_of_a_command_says_what_it_does_and_fits(command, capsys):
    text = help_of(command.split(), capsys)
    assert text.split("\n\n")[1][:1].isupper()
    assert f"  nmpm {command} " in text.partition("\nexamples:\n")[2] or command.startswith("zoo ")
    assert not [line for line in text.splitlines() if len(line) > WIDTH]


def test_help_is_as_wide_as_the_terminal_with_types_and_defaults(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "160")
    for command in ("fit", "rollout"):
        assert max(map(len, help_of([command], capsys).splitlines())) > WIDTH
    text = help_of(["fit"], capsys)
    assert "(int; default: 8)" in text  # frames
    assert "(str | None)" in text  # path
    assert "--frames INTEGER" in help_of(["demo"], capsys)
    assert re.search(r"--out PATH .*[(]default: played.h5[)]", help_of(["play"], capsys))


def test_the_general_help_fits_and_zoo_alone_shows_its_own(capsys):
    assert not [line for line in usage().splitlines() if len(line) > WIDTH]
    assert main(["zoo"]) == 2
    assert "examples:" in capsys.readouterr().err


def test_prose_is_filled_and_examples_stay(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "60")
    prose, _, examples = help_of(["compare"], capsys).partition("examples:")
    assert all(len(line) <= 60 for line in prose.splitlines())
    assert "  nmpm compare waterramps --data waterramps --wider 2     ... in a domain twice as wide?" in examples
