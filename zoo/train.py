"""Train the models of the zoo, one dataset after the other, and make their entries.

    python zoo/train.py                      # all of queue.yaml, in its order
    python zoo/train.py --threads 1          # once per core, or with --device cuda:0, cuda:1 once per GPU
    python zoo/train.py goop wbcsph --hours 8
    python zoo/train.py --data waterdrop=FOLDER   # with recorded data
    python zoo/train.py goop --fresh         # from random weights, not from those of the zoo's entry
    python zoo/train.py --status
    python zoo/train.py --collect            # make entries of the best weights so far, also while others train
    python zoo/train.py wbcsph --simulate    # only simulate what is missing, e.g. before a GPU is rented

A dataset is simulated first if it is missing. Where the zoo has an entry with the curve of its training, training goes
on from its weights, and the hours that it took count. Everything lies in `runs/zoo/NAME`; after any interruption,
kill -9 too, the same command goes on from the last checkpoint. A training that diverges goes on from its best weights
at half of the learning rate. Several of these processes share the work: each takes a dataset that no other one has.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nmpm.zoo.queue.history import History
    from nmpm.zoo.queue.plan import Dataset, Plan
    from nmpm.zoo.queue.training import Training

HERE = Path(__file__).parent
RETREATS = 3
"""Divergences of a training after which it goes on at half of the learning rate."""


def parse(words: list[str] | None = None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="datasets to train (default: all of the queue)")
    parser.add_argument("--queue", type=Path, default=HERE / "queue.yaml", help="what to train (zoo/queue.yaml)")
    parser.add_argument(
        "--runs", type=Path, default=Path("runs/zoo"), help="folder of the trainings (default: runs/zoo)"
    )
    parser.add_argument("--zoo", type=Path, default=HERE, help="folder of the entries (default: that of this script)")
    parser.add_argument(
        "--data", action="append", default=[], metavar="NAME=FOLDER", help="recorded data of a dataset; repeatable"
    )
    parser.add_argument("--hours", type=float, help="stop after this time; the next call goes on")
    parser.add_argument("--threads", type=int, help="processor threads of this process (default: all)")
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda, cuda:1, mps")
    parser.add_argument("--fresh", action="store_true", help="start from random weights where nothing has been started")
    parser.add_argument("--status", action="store_true", help="print how far each dataset is, and train nothing")
    parser.add_argument("--collect", action="store_true", help="make entries of the best weights, and train nothing")
    parser.add_argument(
        "--simulate", action="store_true", help="simulate the data of the next trainings, train nothing"
    )
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> int:
    """Run the queue; the exit status is 0 if nothing failed, 130 after an interruption."""
    chosen = parse(words)
    if chosen.threads is not None:  # before numerical libraries are imported
        for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
            os.environ[variable] = str(chosen.threads)
    from nmpm.errors import NmpmError
    from nmpm.zoo.queue.plan import Plan

    try:
        check_options(chosen)
        data = dict(entry.split("=", 1) for entry in chosen.data)
        plan = Plan.read(chosen.queue).with_data(data).select(chosen.names)
        if chosen.status:
            return print_status(plan, chosen)
        if chosen.collect:
            return max([collect_entry(history, chosen.zoo) for history in histories(plan, chosen)], default=0)
        if chosen.simulate:
            for history, number in ready(plan, chosen, set()):
                simulate(history.dataset_of(number), chosen.threads)
            return 0
        with interruptions(chosen.hours):
            return train_all(plan, chosen)
    except NmpmError as error:
        say(f"error: {error}")
        return 1
    except KeyboardInterrupt:
        say("stopped; the same command goes on.")
        return 130


def check_options(chosen: argparse.Namespace) -> None:
    """Make sure that the options can be followed, before anything is done.

    Raises:
        ConfigError: naming the first that cannot.
    """
    from nmpm.cli.options import check_device
    from nmpm.errors import ConfigError

    for entry in chosen.data:
        name, _, folder = entry.partition("=")
        if not name or not folder:
            raise ConfigError(f"--data {entry}: write NAME=FOLDER, a dataset of the queue and the folder of its data.")
    if chosen.hours is not None and not 0 < chosen.hours < float("inf"):
        raise ConfigError(f"--hours {chosen.hours} must be a positive number.")
    check_device(chosen.device)


def train_all(plan: Plan, chosen: argparse.Namespace) -> int:
    """Train until no dataset is left that this process could take."""
    uncollected, failed = collect_ended(plan, chosen), set[str]()
    while True:
        done = False
        for history, number in ready(plan, chosen, failed):
            with taken(history.folder) as mine:
                if not mine or history.next_round() != number:
                    continue
                done = True
                say(f"{history.dataset.name}, training {number}. {remaining(plan, chosen)}")
                if not train(history, number, chosen):
                    failed.add(history.dataset.name)
            break
        if not done:
            failed |= uncollected
            names = ", ".join(sorted(failed)) or "none"
            left_out = "".join(f" {text}." for text in waits(plan, chosen))
            say(f"nothing is left to take.{left_out} {remaining(plan, chosen)} Failed: {names}.")
            return 1 if failed else 0


def collect_ended(plan: Plan, chosen: argparse.Namespace) -> set[str]:
    """Collect trainings that have ended where a former process died or failed before; the datasets where this fails."""
    from nmpm.zoo.queue.collection import is_collected

    failed = set()
    for history in histories(plan, chosen):
        ended = history.dataset.publish and history.trainings and history.trainings[-1].finished
        if not ended or is_collected(history):
            continue
        with taken(history.folder) as mine:
            if mine and collect_entry(history, chosen.zoo):
                failed.add(history.dataset.name)
    return failed


def ready(plan: Plan, chosen: argparse.Namespace, failed: set[str]) -> Iterator[tuple[History, int]]:
    """Datasets with the number of their next training: all first ones, then all second ones, ….

    Trainings that go on from an entry that already has its dataset's hours count as second ones.
    """
    waiting = (h for h in histories(plan, chosen) if h.dataset.name not in failed and not h.waits_for())
    rounds = [(h, number) for h in waiting if (number := h.next_round()) is not None]
    yield from sorted(rounds, key=lambda entry: entry[1] + entry[0].entry_has_hours())


def train(history: History, number: int, chosen: argparse.Namespace) -> bool:
    """Simulate what is missing, train, and make the entry; False where something failed."""
    from nmpm.errors import NmpmError

    try:
        simulate(history.dataset_of(number), chosen.threads)
        status = fit(history.open(number), chosen.device)
        if status == 130:
            raise KeyboardInterrupt
        return status == 0 and collect_entry(history, chosen.zoo) == 0
    except NmpmError as error:
        say(f"{history.dataset.name}: {error}")
        return False
    except Exception:
        say(f"{history.dataset.name}: {traceback.format_exc()}")
        return False


def fit(training: Training, device: str) -> int:
    """The training's exit status; where it diverges it goes on more slowly from its best weights."""
    from nmpm.cli import main as nmpm
    from nmpm.training.callbacks.divergence import DivergedError

    retreats = 0
    while (status := nmpm([*training.command(), *device_options(device)])) == DivergedError.exit_status:
        if retreats == RETREATS:
            break
        retreats += 1
        rate = training.slow_down(0.5)
        say(f"{training.folder}: has diverged, and goes on from its best weights at a learning rate of {rate:g}.")
    return status


def simulate(dataset: Dataset, threads: int | None) -> None:
    """Simulate the dataset if it is missing, a trajectory per thread at a time."""
    from nmpm.data.catalog import ensure

    generation = dataset.generation()
    if generation is not None:
        name, options = generation
        say(f"{dataset.name}: data in {ensure(name, **{'workers': threads, **options})}.")


def collect_entry(history: History, zoo: Path) -> int:
    """Make the entry of the best weights so far; the exit status, 1 where something fails."""
    from nmpm.cli import main as nmpm
    from nmpm.errors import NmpmError
    from nmpm.zoo.queue.collection import collect

    if not history.dataset.publish:
        return 0
    try:
        say(collect(history, zoo, nmpm))
    except NmpmError as error:
        say(f"{history.dataset.name}: {error}")
        return 1
    except Exception:
        say(f"{history.dataset.name}: {traceback.format_exc()}")
        return 1
    return 0


def device_options(device: str) -> list[str]:
    """Words of `nmpm fit` for one device."""
    kind, _, index = device.partition(":")
    return ["--trainer.accelerator", kind, "--trainer.devices", f"[{index}]" if index else "1"]


def histories(plan: Plan, chosen: argparse.Namespace) -> list[History]:
    """How far each dataset is."""
    from nmpm.zoo.queue.history import History

    entries = {d.name: None if chosen.fresh or not d.publish else chosen.zoo / d.name for d in plan.datasets}
    return [History(d, chosen.runs / d.name, plan.extension, entries[d.name]) for d in plan.datasets]


def waits(plan: Plan, chosen: argparse.Namespace) -> Iterator[str]:
    """What each dataset waits for that cannot be trained yet, in words."""
    for history in histories(plan, chosen):
        needed = history.waits_for()
        if needed:
            what = needed if needed.startswith("--") else f"the training of {needed}"
            yield f"{history.dataset.name} waits for {what}"


def remaining(plan: Plan, chosen: argparse.Namespace) -> str:
    """Hours of training that are left, in words."""
    hours = [history.hours_left() for history in histories(plan, chosen)]
    least, most = (sum(column) for column in zip(*hours, strict=True)) if hours else (0.0, 0.0)
    return f"Left: {least:.1f} h of training, {most:.1f} h if every dataset is extended to its limit."


def print_status(plan: Plan, chosen: argparse.Namespace) -> int:
    """A line per dataset."""
    from nmpm.zoo.queue.validations import lowest_errors, lowest_mse

    for history in histories(plan, chosen):
        curves = [stage.curve() for stage in history.stages]
        errors = lowest_errors(*curves)
        best = curves[errors.index(min(errors))] if any(curves) else []
        error = f"validation MSE {1e3 * lowest_mse(best):.4g} ×10⁻³" if best else "not validated"
        state = "stopped" if history.next_round() is None else f"training {history.next_round()}"
        state = f"needs {history.waits_for()}" if history.waits_for() else state
        sys.stdout.write(f"{history.dataset.name:<22} {state:<27} {history.hours():5.2f} h  {error}\n")
    sys.stdout.write(f"{remaining(plan, chosen)}\n")
    return 0


@contextlib.contextmanager
def taken(folder: Path) -> Iterator[bool]:
    """Whether this process has the dataset to itself; the lock ends with the process, however it ends."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True


@contextlib.contextmanager
def interruptions(hours: float | None) -> Iterator[None]:
    """Stop at SIGTERM as at Ctrl-C, and by SIGTERM to itself when the time is over: trainings write a checkpoint."""
    former = signal.signal(signal.SIGTERM, signal.default_int_handler)
    timer = None if hours is None else threading.Timer(3600 * hours, os.kill, (os.getpid(), signal.SIGTERM))
    try:
        if timer is not None:
            timer.daemon = True
            timer.start()
        yield
    finally:
        if timer is not None:
            timer.cancel()
        signal.signal(signal.SIGTERM, former)


def say(text: str) -> None:
    """Write a line with the time of day."""
    sys.stdout.write(f"\n[{time.strftime('%F %T')}] {text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
