"""Install the wheel in an empty environment; with the network cut, load, roll out and verify every model of the zoo.

python benchmarks/installed_wheel.py
python benchmarks/installed_wheel.py --full --recorded FOLDER/deepmind-waterdrop

Builds the wheel of this checkout, installs it as a stranger would into a new virtual environment outside of the
checkout, and runs everything else in a network namespace that has no network (`unshare`, Linux). The exit status is 1
if the wheel is 60 MB or larger, or a model cannot be loaded, rolled out or confirmed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_BYTES = 60e6
OFFLINE = ("unshare", "--user", "--map-root-user", "--net")
PROBE = """\
import socket, torch
from nmpm import Zoo
try:
    socket.create_connection(("1.1.1.1", 53), 3).close()
    raise SystemExit("the network is not cut")
except OSError:
    pass
for name in Zoo.list():
    model = Zoo.load(name)
    positions = model.rollout(model.example(), frames=64)
    assert torch.isfinite(positions).all(), name
    print(f"{name}: {tuple(positions.shape)}", flush=True)
"""


def main() -> int:
    """Build, install and check; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="verify all test scenes to their end (default: a few)")
    parser.add_argument("--recorded", type=Path, help="the recorded data of the model waterdrop, to verify it too")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wheel = build(Path(folder))
        size = wheel.stat().st_size
        sys.stdout.write(f"{wheel.name}: {size / 1e6:.1f} MB\n")
        programs = install(wheel, Path(folder) / "environment")
        failed = ["the wheel's size"] if size >= MOST_BYTES else []
        for what, words in checks(programs, chosen.full, chosen.recorded):
            sys.stdout.write(f"\n{what}\n")
            sys.stdout.flush()
            failed += [what] if run_offline(words, Path(folder)) else []
    sys.stdout.write(f"\nFailed: {', '.join(failed) or 'nothing'}.\n")
    return 1 if failed else 0


def build(folder: Path) -> Path:
    """The wheel of this checkout, in a folder."""
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run(words, check=True)
    return next(folder.glob("nmpm-*.whl"))


def install(wheel: Path, environment: Path) -> Path:
    """The programs of a new virtual environment with the wheel and the tested versions of what it needs."""
    venv.create(environment, with_pip=True)
    programs = environment / "bin"
    constraints = ["-c", str(ROOT / "constraints.txt")]
    subprocess.run([programs / "pip", "install", "--quiet", *constraints, str(wheel)], check=True)
    return programs


def checks(programs: Path, full: bool, recorded: Path | None) -> list[tuple[str, list[str]]]:
    """What is to be done without network: names and commands."""
    verify = [str(programs / "nmpm"), "zoo", "verify", *(["--full"] if full else [])]
    found = [
        ("every model loads and rolls out", [str(programs / "python"), "-c", PROBE]),
        ("every simulated model is verified", verify),
    ]
    if recorded is not None:
        words = [*verify[:3], "waterdrop", *verify[3:], "--data", str(recorded.resolve())]
        found.append(("waterdrop is verified on its recordings", words))
    return found


def run_offline(words: Sequence[str], folder: Path) -> int:
    """The exit status of a command without network, away from the checkout, and with an empty home of nmpm's."""
    home = {"NMPM_HOME": str(folder / "home"), "HOME": str(folder)}
    return subprocess.run([*OFFLINE, *words], cwd=folder, env=os.environ | home, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
