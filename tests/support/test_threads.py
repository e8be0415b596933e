import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonargparse.typing import PositiveInt

from nmpm._support.threads import (
    CHANGED_CALLS,
    LOOK_AGAIN,
    LOOK_AGAIN_SHARE,
    PAIRS,
    SKIPPED,
    ThreadChoice,
    limit_spinning,
    stated_threads,
)

LOOK = SKIPPED + 2 * PAIRS


class Machine:
    """A clock that the calls of a `ThreadChoice` advance by the seconds that a number of threads takes.

    `noise` (call) multiplies them.
    """

    def __init__(self, seconds, noise=lambda _: 1.0):
        self.seconds, self.now, self.used, self.noise = seconds, 0.0, [], noise

    def call(self, choice, count=1):
        for _ in range(count):
            choice.start()
            self.now += self.seconds[self.used[-1]] * self.noise(len(self.used))
            choice.stop()


def choice_on(machine, monkeypatch):
    monkeypatch.setattr("nmpm._support.threads.usable_cores", lambda: 2)
    return ThreadChoice(None, machine.used.append, lambda: machine.now)


@pytest.mark.parametrize(("seconds", "best"), [({1: 0.3, 2: 0.2}, 2), ({1: 0.3, 2: 0.4}, 1), ({1: 0.3, 2: 14.0}, 1)])
def test_the_faster_of_one_thread_and_all_is_used(monkeypatch, seconds, best):
    machine = Machine(seconds)
    choice = choice_on(machine, monkeypatch)
    machine.call(choice, LOOK + 20)
    assert machine.used[-10:] == [best] * 10
    assert choice.seconds == pytest.approx(seconds)


@given(st.data())
def test_disturbed_calls_do_not_decide(data):
    """Two of each number's calls may be slower, whichever they are and by however much."""
    slow = {
        first + 2 * call: data.draw(st.floats(1, 100))
        for first in (0, 1)
        for call in data.draw(st.lists(st.integers(0, PAIRS - 1), max_size=2, unique=True))
    }
    machine = Machine({1: 0.3, 2: 0.25}, lambda call: slow.get(call - SKIPPED - 1, 1.0))
    with pytest.MonkeyPatch.context() as patch:
        choice = choice_on(machine, patch)
        machine.call(choice, LOOK + 1)
    assert choice.threads == 2


@pytest.mark.parametrize(("first", "then", "kept"), [(0.30, 0.29, 0.31), (0.31, 0.30, 0.32)])
def test_a_difference_below_a_twentieth_changes_nothing(monkeypatch, first, then, kept):
    machine = Machine({1: first, 2: then})
    choice = choice_on(machine, monkeypatch)
    for other in (kept, then, kept, then):
        machine.seconds[2] = other
        machine.call(choice, 2 * round(LOOK_AGAIN / 0.3))
        assert machine.used[-1] == 2


def test_the_choice_follows_a_change_of_load_within_a_few_calls(monkeypatch):
    machine = Machine({1: 0.3, 2: 0.2})
    choice = choice_on(machine, monkeypatch)
    machine.call(choice, LOOK + 30)
    for seconds, best in (({1: 0.3, 2: 0.5}, 1), ({1: 0.15, 2: 0.1}, 2)):
        machine.seconds = seconds
        machine.call(choice, CHANGED_CALLS + 2 * PAIRS + 1)
        assert machine.used[-1] == best
        machine.call(choice, 40)


def test_a_change_that_leaves_the_calls_as_fast_is_seen_at_the_next_look(monkeypatch):
    machine = Machine({1: 0.2, 2: 0.3})
    choice = choice_on(machine, monkeypatch)
    machine.call(choice, LOOK + 10)
    machine.seconds = {1: 0.2, 2: 0.1}  # the other core is free again
    machine.call(choice, round(LOOK_AGAIN / 0.2) + 2 * PAIRS)
    assert machine.used[-1] == 2


def test_looks_cost_a_small_share(monkeypatch):
    machine = Machine({1: 0.3, 2: 0.2})
    choice = choice_on(machine, monkeypatch)
    machine.call(choice, 50)
    machine.seconds = {1: 0.3, 2: 9.0}  # another program came
    machine.call(choice, round(2 * LOOK_AGAIN / 0.2))
    assert machine.used[-1] == 1
    before = len(machine.used)
    machine.call(choice, round(LOOK_AGAIN_SHARE * 20 / 0.3))
    again = [threads for threads in machine.used[before:] if threads == 2]
    assert sum(machine.seconds[threads] for threads in again) <= 0.05 * machine.now


def test_an_option_goes_before_the_environment_and_both_before_measuring():
    assert stated_threads(3, {"OMP_NUM_THREADS": "2"}) == 3
    assert stated_threads(None, {"OMP_NUM_THREADS": "2,1"}) == 2
    assert stated_threads(None, {"OMP_NUM_THREADS": "many"}) is None
    assert stated_threads(None, {}) is None
    assert type(stated_threads(PositiveInt(3), {})) is int


def test_a_waiting_policy_of_the_users_is_kept():
    environment = {"OMP_WAIT_POLICY": "ACTIVE"}
    limit_spinning(environment)
    assert environment == {"OMP_WAIT_POLICY": "ACTIVE"}
    limit_spinning(environment := {})
    assert int(environment["GOMP_SPINCOUNT"]) < 300_000


@pytest.mark.slow
def test_importing_the_package_changes_neither_environment_nor_threads():
    script = (
        "import os, torch\nbefore = dict(os.environ), torch.get_num_threads()\nimport nmpm.training\n"
        "assert before == (dict(os.environ), torch.get_num_threads())"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
