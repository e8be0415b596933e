"""The viewer's page in headless Chromium: what a person clicks, presses and sees."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from nmpm import view
from nmpm.viz import LabelledTrajectories
from tests.conftest import wait_until

WATER = (38, 112, 200)


@pytest.fixture
def open_page(browser, tmp_path):
    """Writes and opens a page; fails at the end if it logged an error."""
    context = browser.new_context(viewport={"width": 900, "height": 640})
    errors = []

    def opened(trajectories):
        path = view(trajectories).write(tmp_path / "page.html")
        page = context.new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(path.as_uri())
        wait_until(page, "window.viewer && viewer.drawn > 0")
        return page

    yield opened
    context.close()
    assert not errors


def one_particle(frames=40, dim=2):
    """A large particle that crosses the box along x; its prediction stays where it was."""
    position = np.full((frames, 1, dim), 0.5)
    position[:, 0, 0] = np.linspace(0.1, 0.9, frames)
    labels = {"simulated": position, "prediction": np.repeat(position[:1], frames, axis=0)}
    return LabelledTrajectories(labels, np.array(["water"]), bounds=((0.0, 1.0),) * dim, dt=0.01)


def picture(page):
    """The canvas as it is on the screen, (height, width, 3)."""
    drawn = page.evaluate("viewer.drawn")
    page.evaluate("viewer.show()")
    wait_until(page, f"viewer.drawn > {drawn}")
    return np.asarray(Image.open(io.BytesIO(page.locator("#scene").screenshot())).convert("RGB")).astype(int)


def water_columns(page):
    """Mean column of the water-coloured pixels of each panel, as a share of the panel's width."""
    pixels = picture(page)
    blue = np.abs(pixels - WATER).sum(axis=2) < 40
    half = pixels.shape[1] // 2
    return [float(np.nonzero(part)[1].mean() / half) for part in (blue[:, :half], blue[:, half:])]


def test_particles_play_and_are_drawn_where_they_are(open_page):
    page = open_page(one_particle())
    left, right = water_columns(page)
    page.click("#play")
    wait_until(page, "viewer.frame > 5")
    page.click("#play")
    stopped = page.evaluate("viewer.frame")
    page.wait_for_timeout(100)
    assert page.evaluate("viewer.frame") == stopped
    page.keyboard.press("End")
    moved, still = water_columns(page)
    assert left == pytest.approx(right, abs=0.01)
    assert still == pytest.approx(right, abs=0.01)
    assert moved - left == pytest.approx(1 - 2 * left, abs=0.02)  # from one side to the other, by symmetry


@pytest.mark.slow
def test_keys_seek_and_choose(open_page):
    page = open_page(one_particle())
    for key, frame in (("ArrowRight", 1), ("Shift+ArrowRight", 11), ("ArrowLeft", 10), ("End", 39), ("Home", 0)):
        page.keyboard.press(key)
        assert page.evaluate("viewer.frame") == frame
    assert "frame 0 of 39" in page.locator("#time").inner_text()
    for colour in ("speed", "error", "material"):
        page.keyboard.press("c")
        assert page.evaluate("viewer.colour") == colour
    page.keyboard.press("o")
    wait_until(page, "document.querySelectorAll('#labels span').length === 1")
    assert "prediction over simulated" in page.locator("#labels").inner_text()
    before = page.evaluate("document.documentElement.dataset.theme")
    page.keyboard.press("t")
    assert {before, page.evaluate("document.documentElement.dataset.theme")} == {"light", "dark"}


@pytest.mark.slow
def test_the_wheel_zooms_and_dragging_turns_until_reset(open_page):
    page = open_page(one_particle(dim=3))
    whole = picture(page)
    page.mouse.move(225, 300)
    page.mouse.wheel(0, -300)
    wait_until(page, "viewer.camera.zoom > 1.5")
    page.mouse.down()
    page.mouse.move(260, 320, steps=4)
    page.mouse.up()
    assert page.evaluate("viewer.camera.turn") != 0.5
    assert np.abs(picture(page) - whole).sum() > 0
    page.click("#reset")
    assert page.evaluate("viewer.camera.zoom") == 1


@pytest.mark.slow
def test_particles_have_the_colours_of_their_fields(open_page):
    cold_to_warm = {"simulated": np.linspace(0.0, 1.0, 40)[:, None]}
    page = open_page(dataclasses.replace(one_particle(), fields={"temperature": cold_to_warm}))
    page.select_option("#colour", label="temperature")
    assert "0.005 or less" in page.locator("#legend").inner_text()
    scale = page.evaluate("scene.scale")
    for frame, expected in ((0, scale[0]), (39, scale[-1])):
        page.evaluate(f"viewer.seek({frame})")
        left, right = np.split(picture(page)[:, : 2 * (900 // 2)], 2, axis=1)
        rgb = [int(expected[at : at + 2], 16) for at in (1, 3, 5)]
        assert np.any(np.abs(left - rgb).sum(axis=2) < 12)
        assert np.any(np.abs(right - WATER).sum(axis=2) < 40)  # the prediction has no temperature
