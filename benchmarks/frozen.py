"""Compare this tree with another one of the same project, such as the state before a large change.

git worktree add ../before COMMIT
python benchmarks/frozen.py ../before
python benchmarks/frozen.py ../before --only rollouts --models goop waterramps --rounds 60

Each tree works in a process of its own, one at a time, call by call, so that both meet the same machine.

rollouts   of all zoo models from a scene of their preset (obstacles included), with constraints and without, eager in
           float32 and bfloat16, and by OpenVINO: the largest difference of positions after one bundle and after 100
           frames, in cells (0 is equality to the bit), and CPU time of this tree over the other's, median and quartiles
exports    the ONNX files of both trees, run by ONNX Runtime: the same figures
verify     `nmpm zoo verify` of both trees
help       the commands, and the options of each, that differ
tests      the README's snippets and the notebooks of this tree

The exit status is 1 if positions differ by more than `--tolerance` cells, a command fails or a test does.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve()
THIS = HERE.parents[1]
FRAMES = 100
FORMS = {
    "eager float32": ("eager", "float32", True),
    "eager float32, free": ("eager", "float32", False),
    "eager bfloat16": ("eager", "bfloat16", True),
    "openvino bfloat16": ("openvino", "bfloat16", True),
}
"""Runtime, precision, and whether with the model's constraints."""


class Worker:
    """A process with one tree's package, which answers one request at a time."""

    def __init__(self, tree: Path) -> None:
        words = [sys.executable, str(HERE), str(tree), "--serve"]
        self._process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment(tree)
        )

    def ask(self, *request: Any) -> Any:
        """The answer to a request, see `serve`."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise SystemExit(f"The process of a tree ended: {self._process.wait()}")
        return json.loads(answer)

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.wait()


def environment(tree: Path) -> dict[str, str]:
    """Variables under which Python takes the package from a tree."""
    return os.environ | {"PYTHONPATH": str(tree), "COLUMNS": "100"}


def serve() -> None:
    """Answer requests from standard input: load a model's form, roll out, time."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what the package prints is no answer
    import torch

    torch.set_num_threads(1)
    actions = Actions()
    for line in sys.stdin:
        name, *values = json.loads(line)
        answers.write(json.dumps(getattr(actions, name)(*values)) + "\n")
        answers.flush()


class Actions:
    """Requests that a worker knows."""

    def load(self, name: str, runtime: str, precision: str, constrained: bool, scene: str) -> dict[str, Any]:
        """A form of a model, and the scene in the file; the cell size and the frames of a bundle are returned."""
        from nmpm.zoo import Zoo

        model = Zoo.load(name)
        arrays = dict(np.load(scene))
        materials = [model.scene.materials[index] for index in arrays.pop("material")]
        self.state = model.state(material=materials, **arrays)
        emulator = model.emulator if constrained else model.emulator.unconstrained()
        self.model = type(model)(emulator, model.card).optimized(runtime, precision)
        return {"cell": min(emulator.grid.spacing), "frames": emulator.frames, "grid": list(emulator.grid.shape)}

    def roll(self, frames: int, path: str) -> None:
        """Write the positions of a rollout."""
        np.save(path, self.model.rollout(self.state, frames).numpy())

    def spent(self, frames: int) -> float:
        """Seconds of processor time that a rollout takes."""
        start = time.process_time()
        self.model.rollout(self.state, frames)
        return time.process_time() - start

    def draw(self, name: str, path: str) -> str | None:
        """Write a scene of the preset that made the data of a model."""
        from nmpm.sim import load_preset

        preset = load_preset(name)
        start = preset.draw(7)
        simulated = preset.simulate_from(start, 1)
        moving = np.isin(simulated.particle_type, (0, 3), invert=True)
        counts = start.counts or (int(moving.sum()),)
        scene = {
            "position": simulated.position[0][moving],
            "velocity": start.velocity,
            "material": np.repeat(np.arange(len(counts)), counts),
        }
        if not moving.all():
            scene["obstacle"] = simulated.position[0][~moving]
        if start.gravity is not None:
            scene["gravity"] = np.asarray(start.gravity)
        np.savez(path, **scene)
        return None


@contextmanager
def workers(other: Path) -> Iterator[tuple[Worker, Worker]]:
    """Processes of this tree and of the other one."""
    pair = Worker(THIS), Worker(other)
    try:
        yield pair
    finally:
        for worker in pair:
            worker.close()


def difference(paths: tuple[Path, Path], cell: float, frames: int) -> tuple[float, float]:
    """Largest difference of positions in cells, after one bundle and after all frames; NaN where only one is NaN."""
    first, second = (np.load(path) for path in paths)
    gap = np.abs(first - second).max(axis=(0, 2, 3)) / cell
    return float(gap[:frames].max()), float(gap.max())


def ratio(calls: tuple[Callable[[], float], Callable[[], float]], rounds: int) -> tuple[str, float]:
    """Median and quartiles of the first call's seconds over the second's, each pair in alternating order."""
    shares, seconds = [], []
    for turn in range(rounds + 1):
        spent = {index: calls[index]() for index in ((0, 1) if turn % 2 else (1, 0))}
        if turn:
            shares.append(spent[0] / spent[1])
            seconds.append(spent[0])
    low, middle, high = statistics.quantiles(shares, n=4)
    return f"{middle:.3f} ({low:.3f}-{high:.3f})", statistics.median(seconds)


def compare_rollouts(other: Path, names: list[str], rounds: int) -> float:
    """Print a line for each model and form; return the largest difference in cells."""
    largest = 0.0
    print(f"{'model':<18} {'form':<20} {'bundle':>8} {'100 fr.':>8} cells   time of a bundle      time of 100 frames")
    with tempfile.TemporaryDirectory() as folder, workers(other) as pair:
        scene, files = Path(folder) / "scene.npz", (Path(folder) / "a.npy", Path(folder) / "b.npy")
        for name in names:
            pair[1].ask("draw", name.partition("/")[0], str(scene))
            for form, settings in FORMS.items():
                facts, _ = (worker.ask("load", name, *settings, str(scene)) for worker in pair)
                for worker, path in zip(pair, files, strict=True):
                    worker.ask("roll", FRAMES, str(path))
                gaps = difference(files, facts["cell"], facts["frames"])
                times = []
                for frames, count in ((facts["frames"], 3 * rounds), (FRAMES, rounds)):
                    calls = tuple(lambda w=worker, f=frames: w.ask("spent", f) for worker in pair)
                    share, seconds = ratio(calls, count)  # type: ignore[arg-type]
                    times.append(f"{share}, {1e3 * seconds / frames:.2f} ms a frame")
                print(f"{name:<18} {form:<20} {gaps[0]:8.1e} {gaps[1]:8.1e}   {'   '.join(times)}", flush=True)
                largest = max(largest, *gaps) if not np.isnan(gaps).any() else np.inf
    return largest


def compare_exports(other: Path, names: list[str], rounds: int) -> float:
    """Export each model by both trees, without contact; print a line for each and return the largest difference."""
    largest = 0.0
    with tempfile.TemporaryDirectory() as folder, workers(other) as pair:
        scene = Path(folder) / "scene.npz"
        for name in names:
            pair[1].ask("draw", name.partition("/")[0], str(scene))
            facts = pair[1].ask("load", name, "eager", "float32", False, str(scene))
            files = []
            for tree, letter in ((THIS, "a"), (other, "b")):
                files.append(str(Path(folder) / f"{letter}.onnx"))
                run(tree, "export", name, "--free", "--out", files[-1])
            outputs, calls = zip(*(onnx_call(path, scene, facts["grid"]) for path in files), strict=True)
            gap = max(float(np.abs(a - b).max()) for a, b in zip(*outputs, strict=True)) / facts["cell"]
            share, seconds = ratio(calls, rounds)
            print(
                f"{name:<18} {'ONNX, free':<20} {gap:8.1e} cells   {share}, {1e3 * seconds:.2f} ms a call", flush=True
            )
            largest = max(largest, gap)
    return largest


def onnx_call(path: str, scene: Path, grid: list[int]) -> tuple[list[Any], Callable[[], float]]:
    """Outputs of an exported step, and a call that takes its time; the velocity is that of a frame of 0."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    arrays = dict(np.load(scene))
    dim = arrays["position"].shape[1]
    possible = {
        "position": arrays["position"][None].astype("float32"),
        "velocity": np.zeros_like(arrays["position"][None], dtype="float32"),
        "material": arrays["material"][None].astype("int64"),
        "gravity": np.full((1, dim), -1e-4, "float32"),
        "solid": np.zeros((1, 1, *grid), "float32"),
        "budget": np.full(1, np.nan, "float32"),
    }
    inputs = {value.name: possible[value.name] for value in session.get_inputs()}

    def spent() -> float:
        start = time.process_time()
        session.run(None, inputs)
        return time.process_time() - start

    return session.run(None, inputs), spent


def run(tree: Path, *words: str) -> tuple[int, str]:
    """Exit status and output of `nmpm` in a tree."""
    done = subprocess.run(
        [sys.executable, "-m", "nmpm", *words],
        cwd=tree,
        env=environment(tree),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )
    return done.returncode, done.stdout


def compare_help(other: Path) -> None:
    """Print the commands and options that only one of the trees has, and how many lines of the help differ."""
    commands = [re.findall(r"^  (\w+)  ", run(tree, "--help")[1], re.MULTILINE) for tree in (THIS, other)]
    here, there = (set(names) for names in commands)
    print(f"commands here alone: {sorted(here - there)}; there alone: {sorted(there - here)}")
    for command in [*commands[1], "zoo list", "zoo card", "zoo add", "zoo verify"]:
        helps = [run(tree, *command.split(), "--help")[1] for tree in (THIS, other)]
        new, old = (set(re.findall(r"(?<!\S)--[\w.]+", text)) for text in helps)
        lines = sum(line[:2] in ("+ ", "- ") for line in difflib.ndiff(*(text.splitlines() for text in helps)))
        print(f"{command:<12} {lines:4d} lines differ; options gone: {sorted(old - new)}; new: {sorted(new - old)}")


def compare_verification(other: Path) -> int:
    """Run `nmpm zoo verify` in both trees, and print the last lines; 1 if this tree's fails."""
    results = [run(tree, "zoo", "verify") for tree in (THIS, other)]
    for label, (status, text) in zip(("here", "there"), results, strict=True):
        print(f"nmpm zoo verify {label}: status {status}\n" + "\n".join(text.splitlines()[-14:]))
    return results[0][0]


def run_tests() -> int:
    """Exit status of the tests of snippets and notebooks."""
    words = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-m",
        "slow or not slow",
        "tests/test_readme.py",
        "tests/test_notebooks.py",
    ]
    return subprocess.run(words, cwd=THIS, env=environment(THIS), check=False).returncode


def main() -> None:
    """Compare what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ["rollouts", "exports", "verify", "help", "tests"]
    parser.add_argument("other", type=Path, help="folder of the other tree")
    parser.add_argument("--only", nargs="+", choices=parts, default=parts)
    parser.add_argument("--models", nargs="+", help="default: all of the zoo")
    parser.add_argument("--rounds", type=int, default=15, help="timed pairs of rollouts over 100 frames")
    parser.add_argument("--tolerance", type=float, default=1e-3, help="of positions, in cells")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    other = options.other.resolve()
    names = options.models or sorted(
        str(path.parent.relative_to(THIS / "zoo")) for path in (THIS / "zoo").rglob("config.yaml")
    )
    wrong = False
    if "rollouts" in options.only:
        wrong |= compare_rollouts(other, names, options.rounds) > options.tolerance
    if "exports" in options.only:
        wrong |= compare_exports(other, names, options.rounds) > options.tolerance
    if "verify" in options.only:
        wrong |= compare_verification(other) != 0
    if "help" in options.only:
        compare_help(other)
    if "tests" in options.only:
        wrong |= run_tests() != 0
    sys.exit(int(wrong))


if __name__ == "__main__":
    main()
