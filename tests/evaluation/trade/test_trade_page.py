"""The trade's page in headless Chromium: points, budget, filters, card, themes."""

import dataclasses
import io

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from nmpm.data.loading.recording import Recording
from nmpm.evaluation.trade import Kind, Scenes
from nmpm.evaluation.trade.accuracy import thumbnail
from nmpm.evaluation.trade.chart import draw_chart
from nmpm.evaluation.trade.page import page_text
from nmpm.scene import Scene
from tests.conftest import wait_until
from tests.evaluation.trade.made_up import point


def made_up_scenes():
    scene = Scene(
        bounds=((0.0, 1.0),) * 2, domain=((0.0, 1.0),) * 2, dt=0.01, materials=("water",), particle_volume=1e-2
    )
    frames = torch.linspace(0.2, 0.8, 6).view(6, 1, 1).expand(6, 5, 2).contiguous()
    recording = Recording(frames, torch.zeros(5, dtype=torch.int64), torch.zeros(0, 2), torch.zeros(2))
    return Scenes("made up </script>", scene, (recording,))


def made_up_points():
    scenes = made_up_scenes()
    picture = thumbnail(scenes, scenes.recordings[0].frames[2])
    shown = dataclasses.replace(point("ours", time=1.0, errors=(0.8, 1.2), model="ours"), picture=picture)
    return [
        point("simulator, 12 substeps", Kind.SIMULATOR, 8.0, (0.0, 0.0)),
        point("simulator, 6 substeps", Kind.SIMULATOR, 4.0, (0.4, 0.6), substeps=6),
        shown,
        point("ours, batch 8", time=0.5, errors=(0.8, 1.2), batch=8),
        point("ours, free", time=0.9, errors=(0.8, 1.2), failures={0: "gains 30% of energy"}),
        point("GNS, not converged", Kind.GRAPH, 3.0, (2.0, 2.4)),
        point("nothing moves", Kind.TRIVIAL, 0.001, (50.0, 50.0)),
        point("nudged", Kind.FLOOR, 8.0, (1e-9, 1e-9)),
    ]


@pytest.fixture
def page(browser, tmp_path):
    path = tmp_path / "trade.html"
    path.write_text(page_text(made_up_points(), made_up_scenes()), encoding="utf-8")
    assert "http" not in path.read_text().replace("http-equiv", "").replace("http://www.w3.org/2000/svg", "")
    context = browser.new_context(viewport={"width": 1000, "height": 700})
    opened, errors = context.new_page(), []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    opened.goto(path.as_uri())
    wait_until(opened, "window.page && document.querySelectorAll('.point').length > 0")
    yield opened
    context.close()
    assert not errors


def names(page):
    return page.evaluate("[...document.querySelectorAll('.point')].map((point) => point.dataset.name)")


def test_kinds_are_drawn_apart_and_filters_hide_them(page):
    assert names(page) == ["simulator, 6 substeps", "ours", "GNS, not converged"]
    assert page.locator(".point.model circle.mark").count() == 1
    assert page.locator(".point.simulator rect.mark").count() == 1
    assert page.locator(".point.graph path.mark").count() == 1
    assert page.locator(".level").count() == 2  # nothing moves, and the simulator as shipped; the floor is far below
    assert "nudged: 1e-9" in page.locator("#about").inner_text()
    page.check("#batches")
    page.check("#unstable")
    assert set(names(page)) == {"simulator, 6 substeps", "ours", "ours, batch 8", "ours, free", "GNS, not converged"}
    page.uncheck("#kind-model")
    page.uncheck("#kind-graph")
    assert names(page) == ["simulator, 6 substeps"]
    assert page.locator("#title").inner_text() == "made up </script>: time and error"


def test_the_budget_decides_the_advice(page):
    advice = page.locator("#advice")
    sentences = {
        0.6: "take nothing moves",
        1.2: "Use the emulator ours",
        5: "Run the simulator, 6",
        9: "as it is",
    }
    for budget, sentence in sentences.items():
        page.evaluate(f"page.budget = {budget}")
        assert sentence in advice.inner_text()
    assert page.locator(".slow").count() == 0
    page.evaluate("page.budget = 1.2")
    assert page.locator(".slow").count() == 2
    page.evaluate("page.budget = 5")
    page.select_option("#pool", "no simulator")
    assert "Use the emulator ours" in advice.inner_text()


def test_pointing_at_a_point_shows_its_settings_and_picture(page):
    page.locator(".point.model .mark").hover()
    card = page.locator("#card")
    assert "CPU" not in card.inner_text()
    assert "1 ms (0.95 to 1.1)" in card.inner_text()
    assert "0.001" not in card.locator("h2").inner_text()
    assert card.locator("canvas").count() == 1
    page.mouse.move(5, 5)
    assert card.is_hidden()
    page.locator(".point.simulator").focus()  # and by the keyboard
    assert "simulator, 6 substeps" in card.inner_text()


def test_errors_axes_and_themes_change_the_picture(page):
    def shot():
        return np.asarray(Image.open(io.BytesIO(page.locator("#chart").screenshot())).convert("RGB")).astype(int)

    page.evaluate("page.setTheme('light')")
    light = shot()
    page.click("#theme")
    dark = shot()
    assert light.mean() > 200
    assert dark.mean() < 70
    page.uncheck("#log")
    assert np.abs(shot() - dark).sum() > 0
    page.select_option("#measure", "mse@8")
    assert "MSE of the first 8 frames" in page.locator("#chart").text_content()


def test_the_picture_is_drawn(tmp_path):
    draw_chart(tmp_path / "trade.png", made_up_points(), made_up_scenes())
    pixels = np.asarray(Image.open(tmp_path / "trade.png").convert("RGB")).astype(int)
    for colour in ((38, 112, 200), (138, 74, 176), (200, 100, 42)):
        assert (np.abs(pixels - colour).sum(-1) < 60).sum() > 50


def test_models_of_other_scenes_are_hollow_in_the_picture_and_names_stay_inside(tmp_path, monkeypatch):
    drawn = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *args, **kwargs: (drawn.append(figure), save(figure, *args, **kwargs))
    )
    foreign = point("theirs (of other scenes), openvino", time=0.7, errors=(0.9, 1.1), model="theirs (of other scenes)")
    floor = point("twin: 6 of 12 substeps", Kind.FLOOR, 4.0, (0.4, 0.6))
    draw_chart(tmp_path / "trade.png", [*made_up_points(), foreign, floor], made_up_scenes())
    (figure,) = drawn
    axes = figure.axes[0]
    fillings = {line.get_label(): line.lines[0].get_markerfacecolor() for line in axes.containers}
    assert fillings["emulator of other scenes"] == "none"
    assert fillings["emulator"] != "none"
    names = {text.get_text(): text.get_window_extent() for text in axes.texts}
    assert {"theirs, openvino", "twin: 6 of 12 substeps"} <= set(names)
    inside = axes.get_window_extent()
    assert all(inside.x0 <= box.x0 and box.x1 <= inside.x1 for box in names.values())
    assert Image.open(tmp_path / "trade.png").width == round(figure.bbox.width)  # or else names have other sizes
