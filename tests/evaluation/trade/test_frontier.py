"""Advice for a budget, and models beside the simulator, from points with known times and errors."""

import pytest

from nmpm.evaluation.trade import Kind
from nmpm.evaluation.trade.frontier import advise, compare_with_simulator, standings
from tests.evaluation.trade.made_up import point

SIMULATOR = [
    point("simulator, 12 substeps", Kind.SIMULATOR, 4.0, (0.0, 0.0)),
    point("simulator, 6 substeps", Kind.SIMULATOR, 2.0, (0.4, 0.6)),
    point("simulator, 3 substeps", Kind.SIMULATOR, 0.5, (9.0, 9.0), failures={1: "gains 30% of energy"}),
]
POINTS = [
    *SIMULATOR,
    point("ours", time=1.0, errors=(0.8, 1.2)),
    point("ours, slower", time=3.0, errors=(0.9, 1.1)),
    point("ours, batch 8", time=0.1, errors=(0.8, 1.2), batch=8),
    point("nothing moves", Kind.TRIVIAL, 0.001, (50.0, 50.0)),
    point("nudged", Kind.FLOOR, 4.0, (0.01, 0.01)),
]


def test_advice_steps_from_the_least_budget_to_the_simulator_itself():
    steps = advise(POINTS, "mse")
    assert [step.name for step in steps] == [
        "", "nothing moves", "ours", "simulator, 6 substeps", "simulator, 12 substeps",
    ]  # fmt: skip
    assert [step.milliseconds for step in steps] == pytest.approx([0, 0.001, 1, 2, 4])
    assert "Nothing that was measured is as fast" in steps[0].sentence
    assert steps[3].sentence.startswith("Run the simulator, 6 substeps")
    assert "the best emulator there, ours, has 1000 (800 to 1200) ×10⁻³." in steps[3].sentence
    assert "it made these data" in steps[4].sentence


def test_without_a_simulator_the_advice_is_an_emulator():
    assert [step.name for step in advise(POINTS, "mse", "no simulator")] == ["", "nothing moves", "ours"]


def test_unstable_points_floors_and_batches_do_not_take_part_in_latency():
    where = standings(POINTS, "mse")
    assert not where["simulator, 3 substeps"].member
    assert where["nudged"].probability == 0
    assert where["ours"].member  # a batch is no answer to one scene
    assert where["ours, batch 8"].member
    assert not where["ours, slower"].member


def test_the_simulator_at_equal_time_and_at_equal_error():
    ours, slower = compare_with_simulator(POINTS, "mse")
    assert ours.at_equal_time is None  # nothing stable is as fast
    name, ratio = ours.at_equal_error
    assert (name, ratio) == ("simulator, 6 substeps", pytest.approx(2.0))
    assert slower.at_equal_time == ("simulator, 6 substeps", pytest.approx(0.5))


def test_a_graph_network_is_advised_like_any_other_and_named_as_what_it_is():
    points = [point("ours", time=1.0, errors=(1.0, 1.2)), point("GNS", Kind.GRAPH, 2.0, (0.5, 0.6))]
    steps = advise(points, "mse")
    assert [step.name for step in steps] == ["", "ours", "GNS"]
    assert steps[-1].sentence.startswith("Use the graph network GNS")
    assert "the best emulator there, ours" in steps[-1].sentence
