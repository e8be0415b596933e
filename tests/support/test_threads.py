import subprocess
import sys

import pytest
from jsonargparse.typing import PositiveInt

from nmpm._support.threads import (
    LOOK_AGAIN,
    LOOK_AGAIN_SHARE,
    SKIPPED,
    ThreadChoice,
    limit_spinning,
    stated_threads,
)


class Machine:
    """A clock that the calls of a `ThreadChoice` advance by the seconds that a number of threads takes."""

    def __init__(self, seconds):
        self.seconds, self.now, self.used = seconds, 0.0, []

    def call(self, choice, count=1):
        for _ in range(count):
            choice.start()
            self.now += self.seconds[self.used[-1]]
            choice.stop()


def choice_on(machine, monkeypatch):
    monkeypatch.setattr("nmpm._support.threads.usable_cores", lambda: 2)
    return ThreadChoice(None, machine.used.append, lambda: machine.now)


@pytest.mark.parametrize(("seconds", "best"), [({1: 0.3, 2: 0.2}, 2), ({1: 0.3, 2: 14.0}, 1)])
def test_the_faster_of_one_thread_and_all_is_used(monkeypatch, seconds, best):
    machine = Machine(seconds)
    choice = choice_on(machine, monkeypatch)
    machine.call(choice, SKIPPED + 20)
    assert machine.used[-10:] == [best] * 10
    assert choice.medians == pytest.approx(seconds)


def test_the_choice_follows_the_load_and_costs_a_small_share(monkeypatch):
    machine = Machine({1: 0.3, 2: 0.2})
    choice = choice_on(machine, monkeypatch)
    machine.call(choice, 50)
    machine.seconds = {1: 0.3, 2: 9.0}  # another program came
    machine.call(choice, round(2 * LOOK_AGAIN / 0.2))
    assert machine.used[-1] == 1
    before = len(machine.used)
    machine.call(choice, round(LOOK_AGAIN_SHARE * 10 / 0.3))
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
