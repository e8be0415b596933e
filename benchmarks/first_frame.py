"""From nothing to the first frames: a fresh process that imports, loads a zoo model, and predicts one bundle.

python benchmarks/first_frame.py --zoo goop --repeats 5
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LIBRARY = "from nmpm import Zoo; model = Zoo.load({name!r}); model.rollout(model.example(), frames=8)"


def seconds(words: list[str]) -> float:
    """Of a command, from its start to its end."""
    start = time.perf_counter()
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)  # noqa: S603
    return time.perf_counter() - start


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
        runs: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(chosen.repeats + 1):
            for name, words in commands.items():
                runs[name].append(seconds(words))
    for name, found in runs.items():
        counted = found[1:]
        sys.stdout.write(f"{name:<26}{statistics.median(counted):.2f} s ({min(counted):.2f}-{max(counted):.2f})\n")


if __name__ == "__main__":
    main()
