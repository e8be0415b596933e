"""`nmpm play` before it serves anything; the rest is in tests/play."""

import subprocess
import sys

import pytest

from nmpm._support.messages import install
from nmpm.cli import main

WITHOUT = """
import importlib.util, sys
real = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name == "websockets" else real(name, *rest)
from nmpm.cli import main
status = main(["play"])
assert "torch" not in sys.modules
sys.exit(status)
"""


def test_without_its_library_it_says_so_before_torch_is_imported():
    ended = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True)
    assert ended.returncode == 1
    assert ended.stderr == (f"nmpm play: the page needs a package that is not installed: {install('play')}.\n")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--port", "99999"], "--port 99999"),
        (["--out", "played.csv"], "--out played.csv"),
        (["--seed", "-1"], "--seed -1"),
        (["nosuch"], "nosuch"),
    ],
    ids=["port", "out", "seed", "model"],
)
def test_wrong_options_are_refused_in_one_line(words, problem, capsys):
    pytest.importorskip("websockets", reason="websockets is not installed")
    assert main(["play", *words]) == 1
    said = capsys.readouterr().err
    assert said.startswith("nmpm play: ")
    assert problem in said
    assert said.count("\n") == 1
