import io

import pytest
from rich.console import Console

from nmpm.evaluation.figures import Unit, error_table, with_unit

PAPER = {"mse@1": 1e-7, "mse": 1.6e-4, "still/mse@1": 2e-4, "still/mse": 1.99, "free_fall/mse": 0.031}


@pytest.mark.parametrize(
    ("scale", "unit", "figures"),
    [
        (1.0, " ×10⁻³", ["0.0001", "0.16", "0.2", "1990", "31"]),
        (800.0**2, " ×10⁶", ["6.4e-08", "0.0001024", "0.000128", "1.274", "0.01984"]),
        (1e-4**2, " ×10⁻⁹", ["1e-06", "0.0016", "0.002", "19.9", "0.31"]),
    ],
)
def test_all_figures_of_a_table_are_in_one_unit(scale, unit, figures):
    table = error_table("x", {name: value * scale for name, value in PAPER.items()})
    out = io.StringIO()
    Console(file=out, width=200).print(table)
    said = out.getvalue()
    assert f"x error{unit} (MSE in length²)" in said
    for figure in figures:
        assert f" {figure} " in said, said


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (5.78, "5780 ×10⁻³"),
        (1.64e-4, "0.164 ×10⁻³"),
        (0.9996, "1000 ×10⁻³"),
        (1e-9, "1 ×10⁻⁹"),
        (0.0, "0 ×10⁻³"),
        (float("nan"), "nan ×10⁻³"),
    ],
)
def test_a_line_names_its_unit(value, text):
    assert with_unit(value) == text


def test_a_diverged_figure_does_not_choose_the_unit():
    assert Unit.of([1e-4, 1e-3, 1e30]) == Unit(-3)
