import dataclasses

import pytest

from nmpm.viz.captions import format_distance, format_out_of_view, format_time


def test_times_have_the_same_number_of_decimals(falling):
    assert [format_time(falling, frame) for frame in (0, 4, 10)] == ["0.0000 s", "0.0100 s", "0.0250 s"]
    slow = dataclasses.replace(falling, dt=1.2)
    assert [format_time(slow, frame) for frame in (0, 10)] == ["0.0 s", "12.0 s"]


@pytest.mark.parametrize(("length", "text"), [(0.0, "0.0000"), (0.0123, "0.0123"), (1.5, "1.5000"), (1e20, "1.0e+20")])
def test_decimals_of_distances_follow_from_the_box(falling, length, text):
    assert format_distance(falling, length) == text


def test_no_text_without_particles_out_of_view():
    assert format_out_of_view(0) == ""
    assert format_out_of_view(3) == "3 out of view"
