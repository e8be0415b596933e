"""`nmpm doctor`: a report on the installation for people who help, and a self-test."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial

from nmpm.cli.doctor_facts import Fact, collect, sections
from nmpm.cli.options import CommandParser, add_device_option, check_device

_DESCRIPTION = """\
Print versions, processor, memory, GPU and caches, and test that this machine computes what it should: a simulation and
rollouts of the model goop beside the figures on its card, and ten steps of a training. Paste all of it into a report;
your home is written as ~.
"""
_EXAMPLES = """\
examples:
  nmpm doctor                   exit status 1 if the self-test fails
  nmpm doctor --device cuda     test the GPU
  nmpm doctor > doctor.txt      to attach it

The self-test takes less than a minute where kernels have been compiled before; the first compiles them, in minutes.
"""
WIDTH = 14


def run(words: list[str]) -> int:
    """Run the command, e.g. ["doctor"]; the exit status."""
    parser = CommandParser(prog="nmpm doctor", description=_DESCRIPTION, epilog=_EXAMPLES)
    add_device_option(parser, "where to test: ")
    device = parser.parse_args(words[1:]).device
    if device != "cpu":  # imports torch, which may be what is broken
        check_device(device)
    start = time.monotonic()
    parts = sections() | {f"self-test on {device}": partial(test, device)}
    failed = [text for title, facts in parts.items() for text in _print(title, facts)]
    verdict = f"FAILED: {failed[0]}" if failed else "The self-test passed."
    _write(f"\n{verdict} All took {time.monotonic() - start:.0f} s.\n")
    return 1 if failed else 0


def test(device: str) -> Iterator[Fact]:
    """Outcomes of the self-test, and the speed."""
    from nmpm.zoo.self_test import self_test, speed

    for check in self_test(device):
        outcome, _, text = str(check).partition("  ")
        yield outcome, text
    yield "speed", speed(device)


def _print(title: str, facts: Callable[[], Iterator[Fact]]) -> list[str]:
    """Print a title and the facts under it, and return the failures among them."""
    _write(f"\n{title}\n")
    failed = []
    for name, text in collect(facts):
        _write(f"  {name:<{WIDTH}} {text}\n")
        failed += [text] if name in ("FAIL", "ERROR") else []
    return failed


def _write(text: str) -> None:
    home = os.path.expanduser("~")  # (Path.home() raises where there is none)
    sys.stdout.write(text if home == "/" else text.replace(home, "~"))
    sys.stdout.flush()
