"""Time a training step and a rollout on a busy or small machine, as ratios to one thread on the quiet machine.

python benchmarks/busy.py                          goop's step and rollout: quiet, beside busy loops, on one core
python benchmarks/busy.py --quota --json busy.json in a control group of one core too (as root, on Linux)

Each figure is of a process of its own that chooses its threads as `nmpm fit` and `nmpm rollout` do. All cases are
measured in turn, `--rounds` times; the rows give medians.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from timing import Spread, describe_machine, make_parser, write_json

from nmpm._support.threads import usable_cores

LOOP = "while True: pass"
ROLLOUT = """
import statistics, sys, time
from nmpm._support.threads import limit_spinning
limit_spinning()
from nmpm import Zoo
from nmpm.cli.options import choose_threads
model = Zoo.load("goop")
choose_threads(model, int(sys.argv[1]) or None)
state, seconds = model.example(count=1000), []
for _ in range(6):
    start = time.perf_counter()
    model.rollout(state, 400)
    seconds.append(time.perf_counter() - start)
print(statistics.median(seconds[1:]))
"""


@dataclass(frozen=True)
class Case:
    """What a process meets.

    Args:
        threads: As by `--threads`; 0 to let it choose.
        loops: Busy loops beside it.
        prefix: Words before its command.
        quota: Cores that its control group allows; 0 for no limit.
    """

    threads: int = 0
    loops: int = 0
    prefix: Sequence[str] = ()
    quota: float = 0.0


CASES: Mapping[str, Case] = {
    "quiet, one thread": Case(threads=1),
    "quiet": Case(),
    "beside a busy loop for each core": Case(loops=usable_cores()),
    "on one core (taskset -c 0)": Case(prefix=["taskset", "-c", "0"]),
}


def main() -> None:
    """Measure, print a table, and write JSON if asked to."""
    parser = make_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=60, help="of each training (default: 60)")
    parser.add_argument("--quota", action="store_true", help="measure in a control group of one core too")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    chosen = parser.parse_args()
    cases = {**CASES, **({"with a quota of one core": Case(quota=1)} if chosen.quota else {})}
    seconds: dict[str, dict[str, list[float]]] = {name: {"step": [], "rollout": []} for name in cases}
    for _ in range(chosen.rounds):
        for name, case in cases.items():
            with load(case) as prefix:
                seconds[name]["step"].append(time_step(case, prefix, chosen.steps))
                seconds[name]["rollout"].append(time_rollout(case, prefix))
    machine = describe_machine(torch.device("cpu"), usable_cores())
    spreads = {name: {what: Spread.of(times) for what, times in both.items()} for name, both in seconds.items()}
    first = next(iter(spreads.values()))
    sys.stdout.write(f"{machine}; goop.yaml, {chosen.rounds} processes each of {chosen.steps} steps and 5 rollouts\n")
    for name, both in spreads.items():
        cells = [f"{both[what].format():>22} ms {both[what].median / first[what].median:6.2f} x" for what in both]
        sys.stdout.write(f"{name:<34}{''.join(cells)}\n")
    write_json(chosen.json, {"machine": machine, "cases": spreads})


@contextmanager
def load(case: Case) -> Iterator[Sequence[str]]:
    """Make what a case meets; gives the words before its command."""
    loops = [subprocess.Popen([sys.executable, "-c", LOOP]) for _ in range(case.loops)]
    try:
        if not case.quota:
            yield case.prefix
            return
        with control_group(case.quota) as processes:
            yield ["sh", "-c", f'echo $$ > {processes} && exec "$@"', "sh"]
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@contextmanager
def control_group(cores: float) -> Iterator[Path]:
    """A control group that allows so many cores; gives the file that takes the processes in it."""
    root = Path("/sys/fs/cgroup")
    folder = (root / "cpu" if (root / "cpu").is_dir() else root) / "nmpm-busy"
    folder.mkdir()
    try:
        if (folder / "cpu.max").exists():
            (folder / "cpu.max").write_text(f"{round(1e5 * cores)} 100000")
        else:
            (folder / "cpu.cfs_quota_us").write_text(str(round(1e5 * cores)))
        yield folder / "cgroup.procs"
    finally:
        folder.rmdir()


def time_step(case: Case, prefix: Sequence[str], steps: int) -> float:
    """Seconds of a step: the mean over a short `nmpm fit --config goop.yaml`, without validations and tests."""
    with tempfile.TemporaryDirectory() as folder:
        threads = ["--threads", str(case.threads)] if case.threads else []
        words = [
            *prefix, sys.executable, "-m", "nmpm", "fit", "--config", "goop.yaml", *threads,
            "--data.generate", '{"counts": {"train": 8, "valid": 1, "test": 1}}', "--trainer.max_steps", str(steps),
            "--trainer.limit_val_batches", "0", "--trainer.limit_test_batches", "1",
            "--trainer.default_root_dir", folder,
        ]  # fmt: skip
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        training = json.loads((Path(folder) / "report.json").read_text())["training"]
    return float(training["seconds"]) / steps


def time_rollout(case: Case, prefix: Sequence[str]) -> float:
    """Seconds of 400 frames of the zoo's goop model."""
    words = [*prefix, sys.executable, "-c", ROLLOUT, str(case.threads)]
    return float(subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout)


if __name__ == "__main__":
    main()
