"""Run all that needs a GPU with one command: tests of CUDA graphs first, rollouts and training steps, then the rest.

python benchmarks/gpu.py --out runs/gpu
python benchmarks/gpu.py --out runs/gpu --dry-run            print the commands
python benchmarks/gpu.py --only tests training_step zoo      some of the steps

Each step writes its output to OUT/STEP.log, whose last line is the exit status. Run the same command again to continue:
steps that ended with status 0 are skipped. Exits with 1 if a step fails; the others run nevertheless.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from timing import make_parser

from nmpm._support.machine import DEVICES, find_device
from nmpm.errors import ConfigError

ROOT = Path(__file__).resolve().parent.parent
STATUS = "exit status "
GRAPHS = "tests/training/test_recorded_steps.py"
"""Of CUDA graphs, which few GPUs have run."""
TRITON = "plugins/nmpm-triton/tests"
"""Of kernels in Triton, which no GPU has run; they skip where that package is not installed."""
TESTS = ("tests/test_on_device.py", "tests/processors", "tests/transfer")
"""What else `--device` changes."""
LARGE_GRIDS = ("64x64", "256x256", "1024x1024", "64x64x64", "128x128x128")


def list_steps(device: str, out: Path) -> dict[str, list[str]]:
    """The command of each step, in order."""
    sizes = ["--particles", "1e3", "1e4", "1e5", "1e6", "1e7", "--grids", *LARGE_GRIDS]
    compared = ["compare", "goop", "--data", "goop"]
    ablation = ["benchmarks/sweeps/parts.yaml", "--minutes", "3", "--out", str(out / "parts")]
    return {
        "graphs": _python("-m", "pytest", "--device", device, GRAPHS),
        "rollouts": _benchmark("gpu_rollouts", device, "--batches", "1", "64"),
        "training_step": _benchmark("training_step", device, "--batch", "128", "--rounds", "20"),
        "fit": _python("-m", "nmpm", "fit", "--config", "goop.yaml"),
        "tests": _python("-m", "pytest", "--device", device, *TESTS),
        "scaling": _benchmark("scaling", device, *sizes),
        "compare": _python("-m", "nmpm", *compared, "--wider", "2", "--device", device, "--out", str(out / "compare")),
        "streaming": _python("benchmarks/streaming.py"),
        "ablation": _benchmark("ablation", device, *ablation),
        "zoo": _benchmark("zoo_on_device", device),
        "triton": _python("-m", "pytest", "-m", "slow", TRITON),
    }


def select_steps(steps: Mapping[str, list[str]], names: Sequence[str] | None) -> dict[str, list[str]]:
    """The steps of these names in their own order; all where no names are given.

    Raises:
        ConfigError: if there is no step of a name.
    """
    if unknown := sorted(set(names or ()) - set(steps)):
        raise ConfigError(f"There is no step {', '.join(unknown)}; there are {', '.join(steps)}.")
    return {name: command for name, command in steps.items() if not names or name in names}


def _python(*words: str) -> list[str]:
    return [sys.executable, *words]


def _benchmark(name: str, device: str, *words: str) -> list[str]:
    return _python(f"benchmarks/{name}.py", *words, "--device", device)


def run_steps(steps: Mapping[str, list[str]], out: Path) -> list[str]:
    """Run the steps that have not succeeded yet.

    Args:
        steps: Commands by name, run in the repository's root.
        out: Folder of the logs.

    Returns:
        Names of the steps that failed.
    """
    out.mkdir(parents=True, exist_ok=True)
    failed = []
    for name, command in steps.items():
        log = out / f"{name}.log"
        if has_succeeded(command, log):
            sys.stdout.write(f"{name}: done before\n")
            continue
        sys.stdout.write(f"{name}: {shlex.join(command)}\n")
        sys.stdout.flush()
        start = time.monotonic()
        status = _run_logged(command, log)
        sys.stdout.write(f"{name}: {STATUS}{status} after {time.monotonic() - start:.0f} s, see {log}\n")
        if status:
            failed.append(name)
    return failed


def _run_logged(command: list[str], log: Path) -> int:
    with log.open("wb") as file:
        file.write(_first_line(command))
        file.flush()
        status = subprocess.run(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT).returncode
        file.write(_last_line(status))
    return status


def has_succeeded(command: list[str], log: Path) -> bool:
    """Whether a log is of this command and ends with status 0; False if it is missing or the step was interrupted."""
    text = log.read_bytes() if log.exists() else b""
    return text.startswith(_first_line(command)) and text.endswith(_last_line(0))


def _first_line(command: list[str]) -> bytes:
    return f"$ {shlex.join(command)}\n".encode()


def _last_line(status: int) -> bytes:
    return f"\n{STATUS}{status}\n".encode()


def main() -> None:
    """Run or print the steps."""
    parser = make_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"), help="folder of the logs (default: runs/gpu)")
    parser.add_argument("--device", choices=DEVICES, default="cuda")
    parser.add_argument("--only", nargs="+", metavar="STEP", help="run these steps (default: all)")
    parser.add_argument("--dry-run", action="store_true", help="print the commands and run nothing")
    chosen = parser.parse_args()
    out = chosen.out.resolve()
    steps = select_steps(list_steps(chosen.device, out), chosen.only)
    if chosen.dry_run:
        sys.stdout.write("".join(f"{name}: {shlex.join(command)}\n" for name, command in steps.items()))
        return
    find_device(chosen.device)
    failed = run_steps(steps, out)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
