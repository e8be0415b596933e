"""`nmpm doctor`: a report on the installation for people who help, and a self-test."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass

from nmpm._support.messages import one_line
from nmpm.cli.command import Command
from nmpm.cli.options import check_device


@dataclass(frozen=True, kw_only=True)
class Doctor(Command):
    """Report on the installation and test it, for help with problems.

    It prints versions, processor, memory, GPU and caches, and tests that this machine computes what it should: a
    simulation and rollouts of the model goop beside the figures on its card, and ten steps of a training. Paste all of
    it into a report; your home is written as ~.

    Args:
        device: Where to test: auto, cpu, cuda or mps; cuda:1 for the second GPU.

    Examples:
        nmpm doctor                   exit status 1 if the self-test fails
        nmpm doctor --device cuda     test the GPU
        nmpm doctor > doctor.txt      to attach it

        The self-test takes less than a minute where kernels have been compiled before; the first compiles them, in
        minutes.
    """

    device: str = "cpu"

    def __post_init__(self) -> None:
        if self.device != "cpu":  # imports torch, which may be what is broken
            check_device(self.device)

    def run(self) -> int:
        from nmpm.zoo import installation

        start, failed = time.monotonic(), list[str]()
        for title, facts in installation.sections(self.device).items():
            _write(f"\n{title}\n")
            try:
                for name, text in facts():
                    _write(f"  {name:<14} {text}\n")
                    failed += [text] * (name == "FAIL")
            except Exception as error:  # of a broken installation, which is what the report is for
                failed.append(one_line(f"{type(error).__name__}: {error}", 300))
                _write(f"  {'ERROR':<14} {failed[-1]}\n")
        verdict = f"FAILED: {failed[0]}" if failed else "The self-test passed."
        _write(f"\n{verdict} All took {time.monotonic() - start:.0f} s.\n")
        return 1 if failed else 0


def _write(text: str) -> None:
    home = os.path.expanduser("~")  # (Path.home() raises where there is none)
    sys.stdout.write(text if home == "/" else text.replace(home, "~"))
    sys.stdout.flush()
