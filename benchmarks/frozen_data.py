"""Record what users get from foreign data and from the command line, and compare two recordings.

python benchmarks/frozen_data.py --fixtures DIR                 once: write the foreign files that the tests make
python benchmarks/frozen_data.py before.json --from DIR         record the tree in PYTHONPATH, or else this one
python benchmarks/frozen_data.py after.json --from DIR --only convert inspect
python benchmarks/frozen_data.py --compare before.json after.json

convert    every fixture, and every file and folder of NMPM_TEST_DATA: digests of the arrays, metadata, lines printed
inspect    of each of these, as text and as JSON
init       the configuration for each of these, on a clock that ticks evenly
match      the table of `nmpm zoo match` for a few of them, with two models
fuzz       damaged files: what was read, or the beginning of the error; `fault` marks what is no error of one line
simulate   a short trajectory of each preset
commands   the help of every command, and mistakes: exit status and lines
api        names of the package, and whether each `nmpm.…` in configurations, zoo, documents and notebooks is there

A recording is one JSON file of outcomes by "section/name". Only the command line and public names are called, so that
the script runs with any tree of the project. Each section has a process of its own; a case that ends it is recorded as
such. The exit status of a comparison is 1 where outcomes differ or are missing.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import difflib
import functools
import hashlib
import importlib
import io
import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve()
TREE = Path(os.environ.get("PYTHONPATH", "").split(os.pathsep)[0] or HERE.parents[1])
SECTIONS = ("convert", "inspect", "init", "match", "fuzz", "simulate", "commands", "api")
MAKERS = (
    "tests/data/convert", "tests/data/test_findings.py", "tests/data/test_inspection.py",
    "tests/data/test_new_configuration.py", "tests/cli/test_convert.py", "tests/cli/test_convert_to_files.py",
    "tests/cli/test_inspect.py", "tests/cli/test_init.py",
)  # fmt: skip
"""Tests whose foreign data become fixtures."""
MOST_BYTES = 4 * 2**20  # of a fixture
MOST_OF_A_TEST = 6  # fixtures; tests by Hypothesis make hundreds
MOST_SECONDS = 120  # of a case
FUZZ_TRIES = {"files": (25, 500), "folders": (10, 100)}
"""Damaged copies of each valid file and folder: as a rule, and of all."""
MATCHED = ("grains", "ptv-tracks", "taichi-wave-flume-2d", "mpm128.npz", "hoomd_gsd", "lagrangebench-3d-lj")
MODELS = ("goop", "waterramps")
Outcome = dict[str, Any]
Case = tuple[str, Callable[[], Outcome]]


# Fixtures: the tests of this tree run once, and what they open is copied.


class Collector:
    """A plugin of pytest that copies what tests open as data, with the options."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._test, self._seen, self._of_test = folder, "", set[str](), 0

    def pytest_configure(self, config: Any) -> None:
        """Watch the doors before the tests import them."""
        del config
        convert, sources, cli = (
            importlib.import_module(name) for name in ("nmpm.data.convert", "nmpm.data.sources", "nmpm.cli")
        )
        for name in ("open_dataset", "convert", "native_folder"):
            self._watch(convert, name)
        made, main = sources.FolderSource.__init__, cli.main

        def watched_source(source: Any, path: Any, *words: Any, **options: Any) -> None:
            made(source, path, *words, **options)
            self.keep(path, None, source.options)

        def watched_main(arguments: Any = None) -> Any:
            if arguments and arguments[0] in ("convert", "init", "inspect"):
                for word in arguments[1:2]:
                    self.keep(word, None, None)
            return main(arguments)

        sources.FolderSource.__init__, cli.main = watched_source, watched_main

    def _watch(self, module: Any, name: str) -> None:
        original = getattr(module, name)

        def watched(path: Any, *words: Any, **named: Any) -> Any:
            values = [*words, *named.values()]
            kind = next((value for value in values if isinstance(value, str)), None)
            options = next((value for value in values if type(value).__name__ == "Options"), None)
            self.keep(path, kind, options)
            return original(path, *words, **named)

        for holder in [m for m in sys.modules.values() if getattr(m, "__name__", "").startswith("nmpm")]:
            if getattr(holder, name, None) is original:
                setattr(holder, name, watched)

    def pytest_runtest_setup(self, item: Any) -> None:
        """Remember the test's name."""
        self._test, self._of_test = f"{Path(item.fspath).stem}.{item.name}", 0

    def keep(self, path: Any, kind: str | None, options: Any) -> None:
        """Copy a file with its folder's other files, or a folder."""
        path = Path(path).resolve()
        if not path.exists() or "converted" in path.parts or path.is_relative_to(TREE) or not self._test:
            return
        base = path if path.is_dir() else path.parent
        files = sorted(file for file in (base.rglob("*") if path.is_dir() else base.glob("*")) if file.is_file())
        if self._of_test >= MOST_OF_A_TEST or sum(file.stat().st_size for file in files) > MOST_BYTES:
            return
        words = ["--format", kind] if kind else []
        words += options.arguments if options is not None else []
        digest = hashlib.sha256(repr((path.name, words)).encode())
        for file in files:
            digest.update(str(file.relative_to(base)).encode() + file.read_bytes())
        if digest.hexdigest() in self._seen:
            return
        self._seen.add(digest.hexdigest())
        self._of_test += 1
        name = re.sub(r"[^\w.-]+", "_", self._test)[:90]
        target = self._folder / f"{name}.{self._of_test}"
        for file in files:
            (target / "data" / file.relative_to(base)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(file, target / "data" / file.relative_to(base))
        (target / "data").mkdir(parents=True, exist_ok=True)
        inner = "data" if path.is_dir() else f"data/{path.name}"
        (target / "case.json").write_text(json.dumps({"path": inner, "words": words}))


def make_fixtures(folder: Path, every: bool) -> None:
    """Write the files that recordings read."""
    import pytest

    folder.mkdir(parents=True)
    os.chdir(TREE)
    sys.path.insert(0, str(TREE))
    import warnings

    warnings.simplefilter("ignore")
    write_mistakes(folder / "mistakes.json")
    write_fuzz(folder / "fuzz", every)
    makers = [name for name in MAKERS if Path(name).exists()]
    arguments = ["-q", "-n", "0", "-p", "no:cacheprovider", *makers]
    for module in [name for name in sys.modules if name.startswith("tests.")]:
        del sys.modules[module]  # the tests import the watched functions
    print("pytest:", pytest.main(arguments, plugins=[Collector(folder / "made")]))


def write_fuzz(folder: Path, every: bool) -> None:
    """Damaged copies of the files and folders of the fuzz tests."""
    fuzz, fuzzing = (importlib.import_module(f"tests.data.{name}") for name in ("test_fuzz", "fuzzing"))
    for name, (file, content, wrap) in fuzz.FORMATS.items():
        for seed in range(FUZZ_TRIES["files"][every]):
            changes = fuzzing.random_changes(random.Random(f"{name} {seed}"))
            target = folder / name.replace(" ", "-") / f"{seed:03}" / "data"
            (target / file).parent.mkdir(parents=True)
            (target / "metadata.json").write_text(json.dumps(fuzz.METADATA))
            (target / file).write_bytes(wrap(fuzzing.damage(content, changes)))
            if file == "metadata.json":
                (target / "train.h5").write_bytes(fuzz.NATIVE)
            (target.parent / "words").write_text("--types=5=water --dt=0.0025")
    for name, write in fuzz.FOLDERS.items():
        with tempfile.TemporaryDirectory() as place:
            write(Path(place))
            for seed in range(FUZZ_TRIES["folders"][every]):
                rng = random.Random(f"{name} {seed}")
                target = folder / name.replace(" ", "-") / f"folder-{seed:03}" / "data"
                shutil.copytree(place, target)
                file = rng.choice(sorted(target.iterdir()))
                file.write_bytes(fuzzing.damage(file.read_bytes(), fuzzing.random_changes(rng)))
                (target.parent / "words").write_text("--dt=0.1")


def write_mistakes(path: Path) -> None:
    """Words of wrong calls, from the tests of mistakes."""
    tests = importlib.import_module("tests.cli.test_mistakes")
    calls = []
    for name, prefix in (
        ("test_a_wrong_option_gets_the_nearest_name", tests.GOOP),
        ("test_a_mistake_is_found_before_the_work", []),
    ):
        marks = getattr(getattr(tests, name), "pytestmark", [])
        calls += [[*prefix, *words] for mark in marks for words, _ in mark.args[1]]
    calls += [words if words[0] in tests.COMMANDS else [*tests.GOOP, *words] for words, _ in tests.EARLY]
    calls += [words for words, _ in tests.USAGES]
    texts = [text for mark in tests.test_a_wrong_configuration.pytestmark for text, _ in mark.args[1]]
    plain = [["file" if word == tests.__file__ else word for word in words] for words in calls]
    path.write_text(json.dumps({"calls": plain, "configurations": texts}, indent=1))


# Cases of a recording.


def data_cases(fixtures: Path) -> Iterator[tuple[str, Path, list[str]]]:
    """Name, path and further words of each file or folder of foreign data."""
    for file in sorted((fixtures / "made").glob("*/case.json")):
        case = json.loads(file.read_text())
        yield file.parent.name, file.parent / case["path"], case["words"]
    root = os.environ.get("NMPM_TEST_DATA")
    if not root:
        return
    several = {"third-party", "native-forms", "experiments", "hostile", "deepmind_metadata", "taichi-elements-2d"}

    def units(folder: Path) -> Iterator[Path]:
        for path in sorted(folder.iterdir()):
            if path.name in several:
                yield from units(path)
            elif not path.name.startswith(".") and path.suffix != ".md":
                yield path

    for path in units(Path(root)):
        yield f"recorded/{path.relative_to(root)}", path, []


class Place:
    """A folder to work in, and the texts that stand for the paths of this machine."""

    def __init__(self, fixtures: Path) -> None:
        self.fixtures = fixtures
        self._folder = tempfile.TemporaryDirectory(prefix="frozen-")
        self.root = Path(self._folder.name).resolve()
        self._count = itertools.count()
        import nmpm

        self._version = nmpm.__version__

    def new(self) -> Path:
        """An empty folder."""
        path = self.root / f"work{next(self._count)}"
        path.mkdir()
        return path

    def plain(self, text: str) -> str:
        """The text without this machine's paths, and the version."""
        test_data = os.environ.get("NMPM_TEST_DATA", "\0")
        for path in (os.environ["NMPM_HOME"], str(self.fixtures), test_data, str(TREE)):
            text = text.replace(path, "…")
        text = re.sub(re.escape(str(self.root)) + r"/work\d+", "…", text)
        text = re.sub(re.escape(tempfile.gettempdir()) + r"/(tmp|nmpm|frozen)[\w-]*", "…", text)
        text = re.sub(r"-[0-9a-f]{10}\b", "-…", text)  # of folders in the cache
        return text.replace(self._version, "VERSION")


def call(place: Place, words: list[str], folder: Path | None = None) -> Outcome:
    """Status and lines of a command; `fault` where an exception leaves it."""
    from nmpm.cli import main

    out, err, before, outcome = io.StringIO(), io.StringIO(), Path.cwd(), Outcome()
    os.chdir(folder or place.new())
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            outcome["status"] = main(words)
    except SystemExit as ended:
        outcome["status"] = ended.code if isinstance(ended.code, int | None) else str(ended.code)
    except CaseTimeoutError:
        raise
    except Exception as error:
        outcome["fault"] = f"{type(error).__name__}: {place.plain(str(error))[:300]}"
    finally:
        os.chdir(before)
    return outcome | {"out": place.plain(out.getvalue()), "err": place.plain(err.getvalue())}


def digest(values: Any) -> str:
    """Type, shape, digest and range of an array."""
    import numpy as np

    array = np.asarray(values)
    content = array.tobytes() if array.dtype.kind != "O" else repr(array.tolist()).encode()
    span = ""
    if array.dtype.kind in "fiu" and array.size and np.isfinite(array).any():
        finite = array[np.isfinite(array)]
        span = f" {finite.min():.7g}:{finite.max():.7g}"
    return f"{array.dtype} {array.shape} {hashlib.sha256(content).hexdigest()[:12]}{span}"


def describe_folder(place: Place, folder: Path) -> Outcome:
    """The files of a dataset: arrays and attributes of HDF5 files, JSON as it is."""
    import h5py

    described = Outcome()
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".json":
            described[name] = json.loads(place.plain(path.read_text()))
        elif path.suffix == ".h5":
            entries = Outcome()

            def visit(key: str, item: Any, entries: Outcome = entries) -> None:
                for attribute, value in item.attrs.items():
                    entries[f"{key}@{attribute}"] = place.plain(str(value))
                if isinstance(item, h5py.Dataset):
                    entries[key] = digest(item[()])

            with h5py.File(path) as file:
                visit("", file)
                file.visititems(visit)
            described[name] = entries
        elif path.is_file():
            described[name] = "a file"
    return described


def convert_case(place: Place, path: Path, words: list[str]) -> Outcome:
    """Convert data and describe the result."""
    folder = place.new()
    outcome = call(place, ["convert", str(path), "out", *words], folder)
    if (folder / "out").is_dir():
        outcome["written"] = describe_folder(place, folder / "out")
    shutil.rmtree(folder)
    return outcome


def inspect_case(place: Place, path: Path, words: list[str]) -> Outcome:
    """What `inspect` says as text and JSON."""
    with even_clock():
        text = call(place, ["inspect", str(path), "--no-picture", *words])
        plain = call(place, ["inspect", str(path), "--json", *words])
    with contextlib.suppress(ValueError):
        plain["out"] = json.loads(plain["out"])
    text["out"] = text["out"].splitlines()
    return {"text": text, "json": plain}


def init_case(place: Place, path: Path, words: list[str]) -> Outcome:
    """The configuration, written on a clock that ticks evenly."""
    folder = place.new()
    with even_clock():
        outcome = call(place, ["init", str(path), "--out", "new.yaml", *words], folder)
    if (folder / "new.yaml").is_file():
        outcome["written"] = place.plain((folder / "new.yaml").read_text()).splitlines()
    return outcome


@contextlib.contextmanager
def even_clock(tick: float = 0.25) -> Iterator[None]:
    """Clocks of which each call is a quarter of a second later, so that measured speeds do not vary."""
    names = ("perf_counter", "process_time", "monotonic", "thread_time")
    before, ticks = {name: getattr(time, name) for name in names}, itertools.count()
    for name in names:
        setattr(time, name, lambda: tick * next(ticks))
    try:
        yield
    finally:
        for name, clock in before.items():
            setattr(time, name, clock)


def match_case(place: Place, path: Path, words: list[str]) -> Outcome:
    """The table of models, of a zoo of two."""
    zoo = place.new()
    for name in MODELS:
        (zoo / name).symlink_to(TREE / "zoo" / name)
    outcome = call(place, ["zoo", "match", str(path), "--root", str(zoo), *words])
    return outcome | {"out": outcome["out"].splitlines()}


def fuzz_case(place: Place, folder: Path) -> Outcome:
    """What is read of damaged data: a digest, or the beginning of the error."""
    outcome = convert_case(place, folder / "data", (folder / "words").read_text().split())
    if "fault" in outcome:
        return {"fault": outcome["fault"][:80]}
    if outcome["status"] == 0:
        return {"ok": hashlib.sha256(json.dumps(outcome["written"], sort_keys=True).encode()).hexdigest()[:12]}
    text = outcome["err"].rstrip("\n").replace(place.plain(str(folder / "data")), "…")
    shown = {"status": outcome["status"], "error": text[:100]}
    return shown | ({"fault": "not one line"} if len(text.splitlines()) != 1 else {})


def simulate_case(name: str) -> Outcome:
    """A short trajectory of a preset."""
    from nmpm.sim import load_preset

    preset = load_preset(name).with_frames(2)
    start = preset.draw(7)
    run = preset.simulate_from(start, 2)
    return {
        key: digest(value)
        for key, value in {**{f"start.{k}": v for k, v in vars(start).items()}, **vars(run)}.items()
        if hasattr(value, "shape")
    }


def mistake_case(place: Place, words: list[str], files: dict[str, str]) -> Outcome:
    """A wrong call in a folder of a few files."""
    folder = place.new()
    (folder / "run").mkdir()
    plain = {"file": "", "run/config.yaml": "model: {cells: 3}\n", "mine.yaml": "model: {cels: 3}\n"}
    for name, text in (plain | files).items():
        (folder / name).write_text(text)
    return call(place, words, folder)


def path_case(name: str) -> Outcome:
    """Whether a dotted name can be imported."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part, None)
        return {"there": found is not None}
    return {"there": False}


def mentioned() -> list[str]:
    """Dotted names of the package in the files that users read and write."""
    files = [TREE / "README.md"]
    for folder in ("configs", "nmpm/configs", "zoo", "docs", "notebooks"):
        files += [
            p for p in (TREE / folder).rglob("*") if p.suffix in (".yaml", ".yml", ".md", ".ipynb", ".py", ".json")
        ]
    texts = (file.read_text(errors="replace") for file in files if file.is_file())
    return sorted({name for text in texts for name in re.findall(r"\bnmpm(?:\.[A-Za-z_]\w*)+", text)})


def names_case() -> Outcome:
    """The public names of the package."""
    import nmpm

    return {"names": sorted(nmpm.__all__)}


def subcommands(place: Place) -> list[list[str]]:
    """All commands and the commands of those that have several."""
    names = re.findall(r"^  (\w+)  ", call(place, ["--help"])["out"], re.MULTILINE)
    inner = re.search(r"\{([\w,-]+)\}", call(place, ["zoo", "--help"])["out"])
    return [[name] for name in names] + [["zoo", name] for name in (inner[1].split(",") if inner else ())]


def cases_of(section: str, place: Place, every: bool) -> Iterator[Case]:
    """The cases of a section by name."""
    fixtures = place.fixtures
    actions = {"convert": convert_case, "inspect": inspect_case, "init": init_case, "match": match_case}
    if section in actions:
        for name, path, words in data_cases(fixtures):
            if section != "match" or Path(name).name in MATCHED:
                if section != "convert" and "--format" in words:
                    words = words[2:]
                yield name, lambda p=path, w=words: actions[section](place, p, w)
    elif section == "fuzz":
        for file in sorted((fixtures / "fuzz").glob("*/*/words")):
            seed = int(file.parent.name.rpartition("-")[2])
            if every or seed < FUZZ_TRIES["folders" if "folder" in file.parent.name else "files"][0]:
                name = str(file.parent.relative_to(fixtures / "fuzz"))
                yield name, lambda f=file.parent: fuzz_case(place, f)
    elif section == "simulate":
        for path in sorted((TREE / "nmpm/sim/presets").glob("*.yaml")):
            yield path.stem, lambda name=path.stem: simulate_case(name)
    elif section == "commands":
        for words in ([], ["--help"], ["--version"]):
            yield f"nmpm {' '.join(words)}", lambda w=words: call(place, w)
        for words in subcommands(place):
            yield f"help {' '.join(words)}", lambda w=words: call(place, [*w, "--help"])
        if (fixtures / "mistakes.json").is_file():
            mistakes = json.loads((fixtures / "mistakes.json").read_text())
            for words in mistakes["calls"]:
                yield f"mistake {' '.join(words)[:120]}", lambda w=words: mistake_case(place, w, {})
            for text in mistakes["configurations"]:
                words = ["fit", "--config", "mine.yaml"]
                name = f"mistake in a configuration {text[:60]!r}"
                yield name, lambda t=text, w=words: mistake_case(place, w, {"mine.yaml": t, "inner.yaml": "a: [\n"})
    else:
        yield "nmpm.__all__", names_case
        for name in mentioned():
            yield name, lambda n=name: path_case(n)


# Recording: a process for each section, started again behind a case that ends it.


class CaseTimeoutError(Exception):
    """A case takes too long."""


def measure_machine_once() -> None:
    """Keep the speed that is measured of this machine, with a stated memory; trees without that function measure it."""
    with contextlib.suppress(ImportError, AttributeError):
        pace = importlib.import_module("nmpm.evaluation.pace")
        measure = pace.measure_machine
        pace.measure_machine = functools.cache(lambda *words: dataclasses.replace(measure(*words), memory=8.0 * 2**30))


def work(section: str, fixtures: Path, out: Path, every: bool, match: str) -> None:
    """Append outcomes to a file of lines, those of the file aside."""
    import logging
    import warnings

    sys.path.insert(0, str(TREE))
    warnings.simplefilter("ignore")
    logging.disable()
    done = {json.loads(line)[0] for line in out.read_text().splitlines()} if out.exists() else set()

    def expire(*_: Any) -> None:
        raise CaseTimeoutError

    signal.signal(signal.SIGALRM, expire)
    if section in ("inspect", "init"):
        measure_machine_once()
    place = Place(fixtures)
    with out.open("a") as file:
        for name, action in cases_of(section, place, every):
            if name in done or not re.search(match, name):
                continue
            (out.parent / "current").write_text(name)
            signal.alarm(MOST_SECONDS)
            try:
                outcome = action()
            except CaseTimeoutError:
                outcome = {"fault": f"longer than {MOST_SECONDS} s"}
            except Exception as error:
                outcome = {"fault": f"{type(error).__name__}: {place.plain(str(error))[:300]}"}
            finally:
                signal.alarm(0)
            file.write(json.dumps([name, outcome], default=str) + "\n")
            file.flush()


def record(sections: Iterable[str], fixtures: Path, every: bool, match: str) -> dict[str, Outcome]:
    """Outcomes of all cases by "section/name"."""
    outcomes = dict[str, Outcome]()
    with tempfile.TemporaryDirectory(prefix="frozen-home-") as home:
        variables = {
            "NMPM_HOME": home,
            "PYTHONPATH": str(TREE),
            "COLUMNS": "120",
            "OMP_NUM_THREADS": "1",
            "NO_COLOR": "1",
        }
        for section in sections:
            start, out = time.monotonic(), Path(home) / f"{section}.lines"
            words = [sys.executable, str(HERE), str(out), "--from", str(fixtures), "--work", section, "--match", match]
            while True:
                done = subprocess.run(
                    [*words, *(["--all"] if every else [])], env=os.environ | variables, capture_output=True, text=True,
                    stdin=subprocess.DEVNULL, check=False,
                )  # fmt: skip
                if done.returncode == 0:
                    break
                current = Path(home) / "current"
                if done.returncode > 0 or not current.exists():
                    raise SystemExit(f"{section}: {done.stderr[-2000:]}")
                with out.open("a") as file:
                    file.write(
                        json.dumps([current.read_text(), {"fault": f"ended by signal {-done.returncode}"}]) + "\n"
                    )
            lines = [json.loads(line) for line in out.read_text().splitlines()]
            outcomes |= {f"{section}/{name}": outcome for name, outcome in lines}
            faults = sum("fault" in json.dumps(list(outcome)) for _, outcome in lines)
            seconds = time.monotonic() - start
            print(f"{section:<9} {len(lines):5d} cases, {faults} faults, {seconds:.0f} s", flush=True)
    return outcomes


def flat(value: Any, key: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys; lists of texts as they are."""
    if isinstance(value, dict) and value:
        return {k: v for name, inner in value.items() for k, v in flat(inner, f"{key}.{name}".strip(".")).items()}
    return {key: value}


def lines_of(value: Any) -> list[str]:
    """A value as lines to compare."""
    if isinstance(value, str):
        return value.splitlines()
    if isinstance(value, list):
        return [one if isinstance(one, str) else json.dumps(one) for one in value]
    return [json.dumps(value)]


def compare(first: dict[str, Outcome], second: dict[str, Outcome], most: int) -> int:
    """Print the differences by case, those of equal text once; the number of cases that differ."""
    texts = dict[str, list[str]]()
    sections = {name.partition("/")[0] for name in first} & {name.partition("/")[0] for name in second}
    names = sorted(name for name in {*first, *second} if name.partition("/")[0] in sections)
    for name in names:
        if name not in first or name not in second:
            texts.setdefault("only in the " + ("first" if name in first else "second"), []).append(name)
            continue
        old, new = flat(first[name]), flat(second[name])
        shown = []
        for key in sorted({*old, *new}):
            if old.get(key) != new.get(key):
                pair = lines_of(old.get(key)), lines_of(new.get(key))
                changed = [line for line in difflib.ndiff(*pair) if line[:1] in "+-"] if max(map(len, pair)) > 1 else [
                    f"- {pair[0][0] if pair[0] else ''}", f"+ {pair[1][0] if pair[1] else ''}"
                ]  # fmt: skip
                shown += [f"  {key}", *(f"    {line[:300]}" for line in changed[:most])]
                shown += [f"    … {len(changed) - most} more lines"] if len(changed) > most else []
        if shown:
            texts.setdefault("\n".join(shown), []).append(name)
    for text, cases in texts.items():
        print("\n".join(cases[:most]) + (f"\n… {len(cases) - most} more cases" if len(cases) > most else ""))
        print(text + "\n")
    differ = sum(map(len, texts.values()))
    print(f"{len(names)} cases of {', '.join(sorted(sections))}: {differ} differ")
    return differ


def main() -> None:
    """Make fixtures, record or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", help="file to write")
    parser.add_argument("--fixtures", type=Path, metavar="DIR", help="write the foreign files that the tests make")
    parser.add_argument("--from", type=Path, metavar="DIR", dest="source", default=Path("frozen-fixtures"))
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("A", "B"))
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--match", default="", help="a pattern of the cases' names")
    parser.add_argument("--all", action="store_true", help="all damaged files (with --fixtures: write them)")
    parser.add_argument("--most", type=int, default=12, help="lines shown of a difference")
    parser.add_argument("--work", choices=SECTIONS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.compare:
        first, second = (json.loads(path.read_text()) for path in options.compare)
        sys.exit(compare(first, second, options.most) > 0)
    if options.fixtures:
        make_fixtures(options.fixtures.resolve(), options.all)
    elif options.out is None:
        parser.error("give the file to write, --fixtures or --compare")
    elif options.work:
        work(options.work, options.source.resolve(), options.out.resolve(), options.all, options.match)
    else:
        outcomes = record(options.only, options.source.resolve(), options.all, options.match)
        options.out.write_text(json.dumps(outcomes, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
