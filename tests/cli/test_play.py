"""`nmpm play` before it serves anything; the rest is in tests/play."""

import subprocess
import sys

from nmpm._support.messages import install

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
