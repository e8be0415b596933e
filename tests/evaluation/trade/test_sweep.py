"""Sweeps in YAML."""

import pytest

from nmpm.errors import NmpmError
from nmpm.evaluation.trade import Sweep, default_sweep_text, read_sweep


def test_the_shipped_sweep_states_the_defaults():
    assert read_sweep(default_sweep_text(), "default.yaml") == Sweep() == read_sweep("", "empty.yaml")


def test_what_a_sweep_leaves_out_is_as_shipped():
    sweep = read_sweep("{scenes: 9, models: {batch: [1]}}", "mine.yaml")
    assert (sweep.scenes, sweep.models.batch, sweep.models.precision) == (9, (1,), Sweep().models.precision)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scene: 3", r"mine.yaml: unknown scene; keys: floors, measures"),
        ("simulator: {substep: [1]}", r"mine.yaml, simulator: unknown substep"),
        ("models: {batch: [0]}", r"models.batch: 0 must be a positive number"),
        ("models: {batch: 8}", r"mine.yaml, models: batch = 8 should be a list, each a whole number"),
        ("models: {batch: [64]}", r"models.batch: 64 scenes at once of 20"),
        ("trivial: [flying]", r"trivial: flying; there are nothing moves, free fall"),
        ("timing: {rounds: 0}", r"rounds = 0"),
        ("{", r"mine.yaml cannot be read"),
        ("[1, 2]", r"mine.yaml should hold keys and values"),
    ],
)
def test_mistakes_are_named(text, message):
    with pytest.raises(NmpmError, match=message):
        read_sweep(text, "mine.yaml")
