import dataclasses

import pytest

from nmpm.viz.captions import clock, distance, unseen


def test_the_clock_has_the_same_decimals_throughout(falling):
    assert [clock(falling, frame) for frame in (0, 4, 10)] == ["0.0000 s", "0.0100 s", "0.0250 s"]
    slow = dataclasses.replace(falling, dt=1.2)
    assert [clock(slow, frame) for frame in (0, 10)] == ["0.0 s", "12.0 s"]


@pytest.mark.parametrize(("length", "text"), [(0.0, "0.0000"), (0.0123, "0.0123"), (1.5, "1.5000"), (1e20, "1.0e+20")])
def test_distances_fit_the_box(falling, length, text):
    assert distance(falling, length) == text


def test_only_particles_out_of_view_are_mentioned():
    assert unseen(0) == ""
    assert unseen(3) == "3 out of view"
