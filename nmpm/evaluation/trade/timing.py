"""Times of choices: all take turns on the same scenes, so that they meet the same machine."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from nmpm.errors import ConfigError, NmpmError
from nmpm.evaluation.machine import clock_for, describe_device, is_machine_failure, peak_bytes
from nmpm.evaluation.trade.choice import Choice, digest
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.store import Store

_WARM_UP = 16  # frames: kernels are chosen and code is compiled in them


@dataclass(frozen=True)
class Timing:
    """How choices are timed.

    Args:
        rounds: Timed rollouts of each choice, each of another scene.
        frames: Longest rollout; shorter where a scene comes to rest earlier, as resting scenes flatter.

    Raises:
        ConfigError: if one is not positive.
    """

    rounds: int = 9
    frames: int = 200

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.frames < 1:
            raise ConfigError(f"timing: rounds = {self.rounds} and frames = {self.frames} must be at least 1.")


@dataclass(frozen=True)
class Times:
    """What was timed of a choice.

    Args:
        milliseconds: Per computed frame and scene, of each round, see `Choice.computed_frames`.
        ratios: Of each round, over the reference's in the same round.
        memory: Peak in bytes, None where it is not known.
        clock: What the time is: "CPU time" or "wall time".
        hardware: Processor or GPU.
    """

    milliseconds: Sequence[float] = ()
    ratios: Sequence[float] = ()
    memory: float | None = None
    clock: str = ""
    hardware: str = ""


@dataclass
class _Runner:
    """A choice, its key in the store and what is known: rounds by number, and the memory."""

    choice: Choice
    key: dict[str, Any]
    known: dict[str, Any] = field(default_factory=dict)

    def lacks(self, turn: int) -> bool:
        return str(turn) not in self.known and "failed" not in self.known


def measure_times(
    choices: Sequence[Choice], reference: Choice, scenes: Scenes, timing: Timing, store: Store
) -> Iterator[None]:
    """Time all choices that lack a round, in an order that turns, the reference among them; yields after each run.

    Args:
        choices: What to time, the reference included.
        reference: The choice that ratios of times are over.
        scenes: What is predicted: round r predicts scene r, and the next ones where a choice takes several at once.
        timing: Rounds and frames.
        store: Keeps each round's times as soon as the round is complete.
    """
    runners = _make_runners(choices, scenes, timing, store)
    warm: set[int] = set()
    for turn in range(timing.rounds):
        missing = [runner for runner in runners if runner.lacks(turn)]
        needed = [runner for runner in runners if runner in missing or (missing and runner.choice is reference)]
        yield from (None for _ in range(len(choices) - len(needed)))
        spent: dict[int, float | None] = {}
        shift = turn % max(1, len(needed))
        for runner in needed[shift:] + needed[:shift]:
            spent[id(runner)] = _time_round(runner, scenes, turn, timing, id(runner) not in warm)
            warm.add(id(runner))
            yield
        base = next((spent[id(runner)] for runner in needed if runner.choice is reference), None)
        for runner in missing:
            milliseconds = spent[id(runner)]
            if milliseconds is not None:
                runner.known[str(turn)] = [milliseconds, base]
            store.write("times", runner.key, runner.known)


def _make_runners(choices: Sequence[Choice], scenes: Scenes, timing: Timing, store: Store) -> list[_Runner]:
    """One for each choice; one for choices that are the same, such as the twin and that number of substeps."""
    keys = {digest(key): (choice, key) for choice in reversed(choices) for key in [_key(choice, scenes, timing)]}
    return [_Runner(choice, key, store.read("times", key)) for choice, key in reversed(keys.values())]


def known_times(choice: Choice, scenes: Scenes, timing: Timing, store: Store) -> Times:
    """What is known of a choice's times."""
    key = _key(choice, scenes, timing)
    known = store.read("times", key)
    rounds = [known[str(turn)] for turn in range(timing.rounds) if str(turn) in known]
    return Times(
        milliseconds=tuple(spent for spent, _ in rounds),
        ratios=tuple(spent / base for spent, base in rounds if base),
        memory=known.get("memory"),
        clock=key["clock"],
        hardware=key["hardware"],
    )


def _key(choice: Choice, scenes: Scenes, timing: Timing) -> dict[str, Any]:
    used = min(len(scenes), timing.rounds - 1 + choice.batch)
    return {
        "choice": dict(choice.identity),
        "scenes": list(scenes.digests[:used]),
        "frames": timing.frames,
        "batch": choice.batch,
        "threads": choice.threads,
        "clock": clock_for(choice.device, choice.threads)[0],
        "hardware": describe_device(choice.device),
        "torch": torch.__version__,
    }


def _time_round(runner: _Runner, scenes: Scenes, turn: int, timing: Timing, warm_up: bool) -> float | None:
    """Milliseconds per computed frame and scene; None where the choice fails, which is stored.

    Where the machine fails the error is raised, so that the round is repeated the next time.
    """
    choice = runner.choice
    indices = [(turn + offset) % len(scenes) for offset in range(choice.batch)]
    frames = min(timing.frames, *(min(scenes.moving_frames(i), scenes.frames(i)) for i in indices))
    before = torch.get_num_threads()
    torch.set_num_threads(choice.threads)
    try:
        run = choice.prepare(scenes, indices)
        if warm_up:
            run(min(frames, _WARM_UP))
        if "memory" not in runner.known:
            memory = peak_bytes(lambda: run(frames), choice.device)
            runner.known["memory"] = memory if memory == memory else None  # (NaN is no JSON)
        _, clock = clock_for(choice.device, choice.threads)
        start = clock()
        run(frames)
        return 1e3 * (clock() - start) / (choice.computed_frames(frames) * choice.batch)
    except NmpmError as error:
        if is_machine_failure(error):
            raise
        runner.known["failed"] = str(error)
        return None
    finally:
        torch.set_num_threads(before)


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile; NaN where there are no values."""
    if len(values) < 2:
        return (values[0],) * 3 if values else (float("nan"),) * 3
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, middle, high
