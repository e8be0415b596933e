"""What Tab offers, as the shell's hook of argcomplete asks for it, in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nmpm.cli import COMMANDS

PROGRAM = "import sys; sys.modules.update(torch=None, numpy=None, lightning=None); from nmpm.cli import main; main()"
"""Fails at an import of what takes long."""


def completions(line: str, folder: Path) -> list[str]:
    """What may follow the line, in the folder."""
    answer = folder / "answer"
    hook = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
    hook |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "NMPM_HOME": str(folder / "home")}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=os.environ | hook, cwd=folder, capture_output=True)
    assert not done.stderr
    return [word.strip() for word in answer.read_text().split("\n")]


@pytest.mark.parametrize(
    ("line", "offered", "not_offered"),
    [
        ("nmpm ", list(COMMANDS), []),
        ("nmpm rollout water", ["waterramps", "waterdrop-xl", "water.h5"], ["goop"]),
        ("nmpm rollout goop --fr", ["--frames"], ["--seed"]),
        ("nmpm rollout mine", ["mine/new"], []),
        ("nmpm zoo verify goop", ["goop", "goop/fast"], []),
        ("nmpm zoo ve", ["verify"], ["list"]),
        ("nmpm simulate dam", ["dambreak2d"], []),
        ("nmpm fit --config goop", ["goop.yaml"], []),
        ("nmpm fit --model.pro", ["--model.processor"], []),
        ("nmpm fit --trainer.max", ["--trainer.max_steps", "--trainer.max_time"], []),
        ("nmpm test --ckpt_path b", ["best"], ["last"]),
    ],
)
def test_tab_offers(tmp_path, line, offered, not_offered):
    (tmp_path / "water.h5").touch()
    (tmp_path / "home" / "zoo" / "mine" / "new").mkdir(parents=True)
    (tmp_path / "home" / "zoo" / "mine" / "new" / "card.yaml").touch()
    words = completions(line, tmp_path)
    assert set(offered) <= set(words)
    assert not set(not_offered) & set(words)
