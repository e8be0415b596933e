"""Time from start to the first frames: a fresh process imports, loads a zoo model, and predicts one bundle.

python benchmarks/first_frame.py --zoo goop --repeats 5
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from timing import Spread, add_device_option, make_parser, time_alternating

PROGRAM = """\
from nmpm import Zoo
model = Zoo.load({name!r}, device={device!r})
model.rollout(model.example(), frames=8).cpu()
"""


def main() -> None:
    """Measure, and print medians with spread."""
    parser = make_parser(__doc__)
    parser.add_argument("--zoo", default="goop")
    parser.add_argument("--repeats", type=int, default=5)
    add_device_option(parser)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "out.h5")
        program = PROGRAM.format(name=chosen.zoo, device=str(chosen.device))
        commands = {
            "import torch": [sys.executable, "-c", "import torch"],
            "Zoo.load, first frames": [sys.executable, "-c", program],
        }
        if chosen.device.type == "cpu":
            command = ["rollout", chosen.zoo, "--frames", "8", "--out", out]
            commands["nmpm rollout"] = [sys.executable, "-m", "nmpm", *command]
        actions = {
            name: partial(subprocess.run, words, check=True, stdout=subprocess.DEVNULL)
            for name, words in commands.items()
        }
        runs = time_alternating(actions, chosen.repeats, warm_up=1)
    for name, found in runs.items():
        sys.stdout.write(f"{name:<26}{Spread.of(found).format(1.0)} s\n")


if __name__ == "__main__":
    main()
