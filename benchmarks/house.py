"""Count what a newcomer has to hold in mind: lines, files, imports, circles, names, and the files that a call enters.

python benchmarks/house.py            lines and files by room, share of lines that import, the largest circle of imports
                                      within a room, classes that share a name, words of docstrings and comments, tests
python benchmarks/house.py --trace    beside these the files and functions of the package that calls enter, and what the
                                      first `Zoo.load` imports; each call in a process of its own
"""

from __future__ import annotations

import argparse
import ast
import collections
import io
import json
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parents[1]
Graph = Mapping[str, set[str]]

WATCH = """
import sys, threading, tempfile, time, warnings
from pathlib import Path
warnings.filterwarnings("ignore")
root, entered = str(Path("nmpm").resolve()) + "/", set()
def watch(frame, event, _):
    code = frame.f_code
    if event == "call" and code.co_filename.startswith(root):
        entered.add((code.co_filename, code.co_qualname))
def start():
    entered.clear()
    threading.setprofile(watch)
    sys.setprofile(watch)
def stop():
    sys.setprofile(None)
    threading.setprofile(None)
    functions = {each for each in entered if not each[1].rpartition(".")[2].startswith("<")}
    return [len({file for file, _ in entered}), len(functions)]
"""
TRACES = {
    "first Zoo.load": """
import torch
torch.set_num_threads(1)
start()
from nmpm import Zoo
Zoo.load("waterramps")
result = {"files, functions": stop(), "modules of nmpm.data": sum(name.startswith("nmpm.data") for name in sys.modules)}
large = ("scipy.signal", "scipy.spatial", "matplotlib", "lightning", "nmpm.data.convert")
result["imported"] = [name for name in large if name in sys.modules]
""",
    "seconds of the first Zoo.load beside torch": """
import torch
before = time.perf_counter()
from nmpm import Zoo
Zoo.load("waterramps")
result = round(time.perf_counter() - before, 2)
""",
    "rollout of one bundle": """
import torch
torch.set_num_threads(1)
from nmpm import Zoo
model = Zoo.load("waterramps")
state, frames = model.example(), model.emulator.frames
model.rollout(state, 2 * frames)
start()
model.rollout(state, frames)
result = {"files, functions": stop()}
""",
    "opening a foreign .npz": """
import numpy as np
import nmpm
def load(name):
    file = folder / name
    steps = np.random.default_rng(0).normal(scale=0.01, size=(30, 50, 2)).cumsum(0)
    np.savez(file, position=(0.5 + steps).astype(np.float32), material=np.repeat([0, 1], 25))
    data = nmpm.load_trajectories(file)
    return data.scene, data.train[0]
folder = Path(tempfile.mkdtemp())
load("first.npz")
start()
load("second.npz")
result = {"files, functions": stop()}
""",
}
"""Scripts that set `result`. A foreign file gives its scene and first trajectory, after another one has."""


def largest_circle(graph: Graph) -> int:
    """Size of the largest part of a graph whose nodes all reach one another."""

    def reach(start: str, edges: Graph) -> set[str]:
        reached, todo = {start}, [start]
        while todo:
            new = edges[todo.pop()] - reached
            reached |= new
            todo += new
        return reached

    backwards: dict[str, set[str]] = {node: set() for node in graph}
    for node, others in graph.items():
        for other in others:
            backwards[other].add(node)
    return max((len(reach(node, graph) & reach(node, backwards)) for node in graph), default=0)


def module_name(file: Path) -> str:
    """The dotted name of a file of the package."""
    return ".".join(file.relative_to(PROJECT).with_suffix("").parts).removesuffix(".__init__")


def imported_modules(tree: ast.Module, names: Iterable[str]) -> set[str]:
    """The modules of the package that a file imports, anywhere in it."""
    known, found = set(names), set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in known else node.module)
    return found & known


def words_of_prose(text: str, tree: ast.Module) -> int:
    """Words in docstrings and comments."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docs = sum(len((ast.get_docstring(n) or "").split()) for n in ast.walk(tree) if isinstance(n, documented))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return docs + sum(len(token.string.split()) - 1 for token in tokens if token.type == tokenize.COMMENT)


def count() -> dict[str, Any]:
    """The counts of the package."""
    texts = {module_name(file): file.read_text() for file in sorted((PROJECT / "nmpm").rglob("*.py"))}
    trees = {name: ast.parse(text) for name, text in texts.items()}
    lines = {name: len(text.splitlines()) for name, text in texts.items()}
    graph = {name: imported_modules(tree, texts) - {name} for name, tree in trees.items()}
    rooms = collections.defaultdict(set)
    for name in texts:
        rooms[name.split(".")[1] if "." in name else name].add(name)
    importing = sum(
        len({line for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom) for line in lines_of(n)})
        for tree in trees.values()
    )
    classes = collections.Counter(
        node.name
        for tree in trees.values()
        for node in tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    circles = {room: largest_circle({name: graph[name] & names for name in names}) for room, names in rooms.items()}
    return {
        "lines": sum(lines.values()),
        "files": len(texts),
        "imports %": round(100 * importing / sum(lines.values()), 1),
        "words": sum(words_of_prose(text, trees[name]) for name, text in texts.items()),
        "largest circles": {room: size for room, size in circles.items() if size > 1},
        "class names that stand twice": sorted(name for name, number in classes.items() if number > 1),
        "tests": sum(len(file.read_text().splitlines()) for file in (PROJECT / "tests").rglob("*.py")),
        "by room": {
            room: [sum(lines[name] for name in names), len(names)]
            for room, names in sorted(rooms.items())
            if len(names) > 1
        },
    }


def lines_of(node: ast.stmt) -> range:
    """The lines that a statement covers."""
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


def trace(script: str) -> Any:
    """What a script of `TRACES` results in, in a process of its own."""
    words = [sys.executable, "-c", f"{WATCH}{script}\nimport json\nprint(json.dumps(result))"]
    ran = subprocess.run(words, capture_output=True, text=True, cwd=PROJECT, check=False)
    return json.loads(ran.stdout.splitlines()[-1]) if ran.returncode == 0 else ran.stderr[-300:]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trace", action="store_true")
    options, result = parser.parse_args(), count()
    if options.trace:
        result |= {name: trace(script) for name, script in TRACES.items()}
    print(json.dumps(result, indent=1))
