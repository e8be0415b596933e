"""From nothing to the first frames: a fresh process that imports, loads a zoo model, and predicts one bundle.

python benchmarks/first_frame.py --zoo goop --repeats 5
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from turns import Spread, in_one_process

LIBRARY = "from nmpm import Zoo; model = Zoo.load({name!r}); model.rollout(model.example(), frames=8)"


def main() -> None:
    """Measure in turns and print medians with spread."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zoo", default="goop")
    parser.add_argument("--repeats", type=int, default=5)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "out.h5")
        commands = {
            "import torch": [sys.executable, "-c", "import torch"],
            "Zoo.load, first frames": [sys.executable, "-c", LIBRARY.format(name=chosen.zoo)],
            "nmpm rollout": [sys.executable, "-m", "nmpm", "rollout", chosen.zoo, "--frames", "8", "--out", out],
        }
        actions = {
            name: partial(subprocess.run, words, check=True, stdout=subprocess.DEVNULL)
            for name, words in commands.items()
        }
        runs = in_one_process(actions, chosen.repeats)
    for name, found in runs.items():
        sys.stdout.write(f"{name:<26}{Spread.of(found).shown(1.0)} s\n")


if __name__ == "__main__":
    main()
