"""The report: tidy CSV, JSON and table that state the same figures, and pictures."""

import csv
import itertools
import json

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from nmpm.data.windows import Recording
from nmpm.emulator.digests import weights_digest
from nmpm.evaluation.trade import Kind, Scenes, Store, measure
from nmpm.evaluation.trade.charts import draw_chart
from nmpm.evaluation.trade.report import (
    csv_text,
    describe,
    likely_points,
    markdown_text,
    report_lines,
    summary_table,
    write_report,
)
from nmpm.scene import Scene
from nmpm.viz.output import STYLES
from tests.evaluation.trade.made_up import point, tiny_emulator, tiny_sweep


@pytest.fixture(scope="module")
def points(scenes, choices, tmp_path_factory):
    return measure(choices, scenes, tiny_sweep(), Store(tmp_path_factory.mktemp("store")))


def test_the_table_is_tidy(points, scenes):
    header, *rows = csv_text(points, scenes).splitlines()
    table = list(csv.DictReader([header, *rows]))
    assert len({(row["name"], row["error"]) for row in table}) == len(table) == 7 * len(points)
    first = next(row for row in table if row["name"] == "carried, batch 2" and row["error"] == "mse")
    assert (first["kind"], first["batch"], first["constraints"]) == ("model", "2", "held")
    assert first["weights"] == weights_digest(tiny_emulator(scenes.scene).state_dict())[:12]
    assert float(first["low"]) <= float(first["value"]) <= float(first["high"])
    assert np.isclose(float(first["frames_per_second"]) * float(first["ms_per_frame"]), 1000, rtol=1e-3)


def test_files_and_table_state_the_same_figures(points, scenes):
    plain = {one["name"]: one for one in json.loads(json.dumps(describe(points, scenes)))["predictors"]}
    still = next(one for one in points if one.name == "nothing moves")
    assert plain[still.name]["errors"]["mse"]["mean"] == pytest.approx(still.mean("mse"), rel=1e-4)
    assert len(plain[still.name]["curve"]) == scenes.frames(0)
    page = markdown_text("trade", points, scenes)
    assert f"| {1e3 * still.mean('mse'):.3g} (" in page
    assert all(line in page for line in report_lines(points))
    shown = likely_points(points)
    assert still in shown
    assert summary_table(shown, points, scenes).row_count == len(shown) < len(points)


def made_up_scenes():
    scene = Scene(
        bounds=((0.0, 1.0),) * 2, domain=((0.0, 1.0),) * 2, dt=0.01, materials=("water",), particle_volume=1e-2
    )
    frames = torch.linspace(0.2, 0.8, 6).view(6, 1, 1).expand(6, 5, 2).contiguous()
    recording = Recording(frames, torch.zeros(5, dtype=torch.int64), torch.zeros(0, 2), torch.zeros(2))
    return Scenes("made up", scene, (recording,))


def test_failures_and_what_differs_from_training_are_said():
    foreign = point("theirs", model="theirs (of other scenes)", scenes_differ_in="bounds, domain")
    failed = point("bad", failures={1: "gains 30% of energy"})
    lines = report_lines([foreign, failed])
    assert "theirs (of other scenes): what differs from those of its training: bounds, domain" in lines
    assert lines[-1] == "bad: unstable in 1 scenes, first in scene 1: gains 30% of energy"


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are saved."""
    figures = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *args, **kwargs: (figures.append(figure), save(figure, *args, **kwargs))
    )
    return figures


def test_kinds_are_drawn_apart_and_names_stay_inside(tmp_path, drawn):
    points = [
        point("simulator, 12 substeps", Kind.SIMULATOR, 8.0, (0.0, 0.0)),
        point("simulator, 6 substeps", Kind.SIMULATOR, 4.0, (0.4, 0.6), substeps=6),
        point("ours", time=1.0, errors=(0.8, 1.2), model="ours"),
        point("ours, batch 8", time=0.5, errors=(0.8, 1.2), batch=8),
        point("ours, free", time=0.9, errors=(0.8, 1.2), failures={0: "gains 30% of energy"}),
        point("theirs (of other scenes)", time=0.7, errors=(0.9, 1.1), scenes_differ_in="domain"),
        point("a graph", Kind.OTHER, 3.0, (2.0, 2.4)),
        point("nothing moves", Kind.TRIVIAL, 0.001, (50.0, 50.0)),
        point("twin: 6 of 12 substeps", Kind.FLOOR, 4.0, (0.4, 0.6)),
        point("nudged", Kind.FLOOR, 8.0, (1e-9, 1e-9)),
    ]
    draw_chart(tmp_path / "trade.png", points, made_up_scenes())
    pixels = np.asarray(Image.open(tmp_path / "trade.png").convert("RGB")).astype(int)
    for colour in ((38, 112, 200), (138, 74, 176), (200, 100, 42)):
        assert (np.abs(pixels - colour).sum(-1) < 60).sum() > 50
    axes = drawn[0].axes[0]
    fillings = {line.get_label(): line.lines[0].get_markerfacecolor() for line in axes.containers}
    assert fillings["emulator of other scenes"] == "none" != fillings["emulator"]
    assert "nudged: 1e-09" in axes.get_title()
    inside = axes.get_window_extent()
    names = {text.get_text().strip(): text.get_window_extent() for text in axes.texts}
    assert set(names) - {""} == {
        "better", "6 substeps", "ours", "theirs", "a graph", "nothing moves", "twin: 6 of 12 substeps",
    }  # fmt: skip
    assert all(inside.x0 - 1 <= box.x0 and box.x1 <= inside.x1 + 1 for name, box in names.items() if name)


def test_at_most_ten_names_are_written_and_none_over_another(tmp_path, drawn):
    rng = np.random.default_rng(0)
    points = [
        point(f"a model with number {number}", time=time, errors=(error, error))
        for number, (time, error) in enumerate(rng.uniform(1, 2, size=(40, 2)))
    ]
    draw_chart(tmp_path / "trade.png", points, made_up_scenes())
    boxes = [Text.get_window_extent(text) for text in drawn[0].axes[0].texts]
    assert 5 < len(boxes) <= 11  # with "better"
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    (frontier,) = (line for line in drawn[0].axes[0].lines if line.get_label() == "frontier")
    assert np.all(np.diff(frontier.get_xdata()) > 0)
    assert np.all(np.diff(frontier.get_ydata()) < 0)


def test_a_style_adds_the_chart_in_its_format(tmp_path):
    points = [point("ours", errors=(0.8, 1.2), model="ours"), point("theirs", time=3.0, errors=(0.4, 0.5))]
    for name, start in (("talk", b"<?xml"), ("paper", b"%PDF")):
        *_, path = write_report(tmp_path, "trade", points, made_up_scenes(), STYLES[name])
        assert path.read_bytes().startswith(start)
