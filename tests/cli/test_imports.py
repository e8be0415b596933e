"""What a command does not need it does not import: torch takes a second, Lightning three."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("words", "unwanted"),
    [
        (["rollout", "goop", "--frames", "8", "--out", "out.h5"], {"lightning", "neuralop", "matplotlib"}),
        (["simulate", "--list"], {"lightning", "torch", "matplotlib"}),
        (["zoo", "card", "goop"], {"lightning", "matplotlib"}),
        (["--version"], {"lightning", "torch", "numpy"}),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_command_leaves_alone_what_it_does_not_need(words, unwanted, tmp_path):
    script = (
        f"import sys; from nmpm.cli import main; assert main({words!r}) == 0; "
        f"print('imported', sorted({unwanted!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.splitlines()[-1] == "imported []"
