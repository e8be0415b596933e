"""The viewer's page in headless Chromium: what a person clicks, presses and sees."""

import base64
import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from nmpm import view
from nmpm.viz import LabelledTrajectories
from nmpm.viz.ensembles import front, occupied_share
from nmpm.viz.page import bundle
from tests.conftest import wait_until

WATER = (38, 112, 200)


@pytest.fixture
def open_page(visit, tmp_path):
    """Opens a page that shows trajectories, at the first frame."""

    def opened(trajectories):
        path = view(trajectories).write(tmp_path / "page.html")
        page = visit(path.as_uri(), "window.viewer && viewer.drawn > 0", 900, 640)
        page.evaluate("viewer.stopAt(0), viewer.setColour('material')")
        return page

    return opened


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
    turn = page.evaluate("viewer.camera.turn")
    page.mouse.move(225, 300)
    page.mouse.wheel(0, -300)
    wait_until(page, "viewer.camera.zoom > 1.5")
    page.mouse.down()
    page.mouse.move(260, 320, steps=4)
    page.mouse.up()
    assert page.evaluate("viewer.camera.turn") != turn
    assert np.abs(picture(page) - whole).sum() > 0
    page.click("#reset")
    assert page.evaluate("viewer.camera.zoom") == 1


@pytest.mark.slow
def test_particles_have_the_colours_of_their_fields(open_page):
    cold_to_warm = {"simulated": np.linspace(0.0, 1.0, 40)[:, None]}
    page = open_page(dataclasses.replace(one_particle(), fields={"temperature": cold_to_warm}))
    page.select_option("#colour", label="temperature")
    assert "0.005" in page.locator("#legend").inner_text()
    bar = page.evaluate(
        "(({ width, height }, context) => [...context.getImageData(0, 0, width, height).data])("
        "document.querySelector('#legend canvas'), document.querySelector('#legend canvas').getContext('2d'))"
    )
    scale = np.reshape(bar, (-1, 4))[:, :3]
    for frame, rgb in ((0, scale[0]), (39, scale[-1])):
        page.evaluate(f"viewer.seek({frame})")
        left, right = np.split(picture(page)[:, : 2 * (900 // 2)], 2, axis=1)
        assert np.any(np.abs(left - rgb).sum(axis=2) < 24)
        assert np.any(np.abs(right - WATER).sum(axis=2) < 40)  # the prediction has no temperature


def shown_ensemble(members=4, frames=6, dim=2):
    """A truth, a member a little to the right of it, and further members that go on to the right."""
    rng = np.random.default_rng(0)
    truth = np.repeat(rng.uniform(0.2, 0.4, size=(1, 60, dim)), frames, axis=0)
    along = np.eye(dim)[0] * np.linspace(0, 0.4, frames)[:, None, None]
    further = {f"member {number}": truth + number / members * along for number in range(1, members)}
    return LabelledTrajectories(
        {"truth": truth, "member 0": truth + 0.001},
        np.array(["water"] * 60),
        bounds=((0.0, 1.0),) * dim,
        dt=0.01,
        further_members=further,
        gravity=(0.0, -9.81, 0.0)[:dim],
    )


def test_an_ensemble_is_drawn_as_points_or_density_or_one_member(open_page):
    ensemble = shown_ensemble()
    page = open_page(ensemble)
    page.keyboard.press("End")
    pictures = {}
    for mode in ("faint", "density", "0", "3"):
        page.select_option("#members", mode)
        pictures[mode] = picture(page)
    left = {mode: pixels[:, : pixels.shape[1] // 2 - 4] for mode, pixels in pictures.items()}
    right = {mode: pixels[:, pixels.shape[1] // 2 + 4 :] for mode, pixels in pictures.items()}
    for mode in ("density", "0", "3"):
        assert np.array_equal(left[mode], left["faint"])  # the truth
        assert (right[mode] != right["faint"]).any()
    assert (right["0"] != right["3"]).any()
    assert "10, 50, 90% of 4 members" not in page.locator("#legend").inner_text()
    page.select_option("#members", "density")
    assert "10, 50, 90% of 4 members" in page.locator("#legend").inner_text()


@pytest.mark.parametrize("stride", [1, 2])
def test_the_density_counts_the_particles_of_each_member_that_are_on_the_page(open_page, monkeypatch, stride):
    monkeypatch.setattr("nmpm.viz.viewer.MEMBER_BYTES", 2 * 6 * 60 * 2 * 3 // stride)
    ensemble = shown_ensemble()
    page = open_page(ensemble)
    bands = page.evaluate("JSON.parse(document.getElementById('data').textContent).bands")
    assert bands["stride"] == stride
    density = page.evaluate("({ shares: [...viewer.ensemble.density.share(5)], cells: viewer.ensemble.density.cells })")
    last = [member[5, ::stride] for member in ensemble.members.values()]
    expected = occupied_share(last, np.zeros(2), bands["cell"], tuple(density["cells"]))
    difference = np.reshape(density["shares"], expected.shape[::-1]).T - expected
    assert (np.abs(difference) > 1e-6).mean() < 0.01  # rounding moves few particles to another cell


def test_the_chart_of_an_ensemble_shows_the_chosen_quantity(open_page):
    ensemble = shown_ensemble()
    page = open_page(ensemble)
    page.keyboard.press("End")
    names = page.locator("#quantity option").all_inner_texts()
    assert [name.split(" (")[0] for name in names] == ["mean height", "front", "kinetic energy", "RMS position error"]
    page.select_option("#quantity", label=names[1])
    fronts = [front(ensemble, member)[-1] for member in ensemble.members.values()]
    low, high = np.quantile(fronts, [0.05, 0.95])
    band = f"90%: {float(f'{low:.4g}'):g} … {float(f'{high:.4g}'):g}"
    wait_until(page, f"document.getElementById('now').textContent.includes('{band}')")
    page.keyboard.press("m")
    assert page.evaluate("viewer.ensemble.mode") == "density"


@pytest.mark.slow
def test_members_in_space_are_faint_or_one(open_page):
    page = open_page(shown_ensemble(dim=3))
    page.keyboard.press("End")
    assert page.locator("#members option").all_inner_texts() == ["all, faint", *(f"member {k}" for k in range(4))]
    several = picture(page)
    page.select_option("#members", "0")
    assert (picture(page) != several).any()


def test_pages_start_to_play_fit_a_phone_and_say_what_is_under_the_pointer(browser, tmp_path):
    water = one_particle()
    path = view(dataclasses.replace(water, title="a model with a long name: 1,234,567 particles of water")).write(
        tmp_path / "page.html"
    )
    page = browser.new_page(viewport={"width": 390, "height": 760})
    page.goto(path.as_uri())
    wait_until(page, "window.viewer && viewer.playing && viewer.frame > 0")
    assert page.evaluate("viewer.colour") == "speed"
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.evaluate("viewer.stopAt(20)")
    box = page.locator("#scene").bounding_box()
    at = page.evaluate("(({ x, y, width, height }) => [x + width / 2, y + height / 2])(viewer.panels()[0])")
    page.mouse.move(box["x"] + at[0] + 2, box["y"] + at[1])
    assert page.locator("#particle").inner_text() == "particle 0, water, 2.05 length/s"
    page.mouse.move(box["x"] + 3, box["y"] + 3)
    assert page.locator("#particle").is_hidden()
    page.close()


def test_pictures_and_films_are_saved(open_page, tmp_path):
    page = open_page(one_particle(frames=12))
    with page.expect_download() as saved:
        page.click("#picture")
    saved.value.save_as(tmp_path / "a.png")
    shown = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    assert (np.abs(shown - WATER).sum(axis=2) < 40).any()
    with page.expect_download() as saved:
        page.click("#film")
    saved.value.save_as(tmp_path / "a.webm")
    assert (tmp_path / "a.webm").read_bytes()[:4] == bytes.fromhex("1a45dfa3")  # EBML, of which WebM is
    assert saved.value.suggested_filename == "nmpm.webm"


def test_animations_are_saved_as_gif(open_page, tmp_path):
    page = open_page(one_particle(frames=12))
    page.evaluate("document.getElementById('rate').value = 15")
    with page.expect_download() as saved:
        page.click("#gif")
    saved.value.save_as(tmp_path / "a.gif")
    animation = Image.open(tmp_path / "a.gif")
    assert animation.n_frames == 12
    assert animation.info["duration"] == pytest.approx(1000 / 15, abs=5)
    assert animation.size[0] <= 720
    shown = []
    for frame in range(12):
        animation.seek(frame)
        pixels = np.asarray(animation.convert("RGB")).astype(int)
        shown.append(np.argwhere(np.abs(pixels - WATER).sum(axis=2) < 40).mean(axis=0))
    assert np.isfinite(shown).all()
    assert abs(np.diff(shown, axis=0)).max(axis=1).min() > 0  # it moves


@pytest.mark.parametrize("colours", [1, 2, 256, 5000])
def test_gifs_hold_the_colours_that_they_are_given(open_page, colours):
    page = open_page(one_particle(frames=3))
    rng = np.random.default_rng(colours)
    palette = rng.integers(0, 256, (colours, 3))
    image = np.dstack([palette[rng.integers(colours, size=(150, 131))], np.full((150, 131), 255)]).astype(np.uint8)
    text = base64.b64encode(image.tobytes()).decode()
    page.add_script_tag(content=f"{bundle('gif')} window.gif = modules.gif;")
    made = page.evaluate(
        """async (text) => {
          const gif = new window.gif.Gif(131, 150);
          gif.add(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)), 4);
          return Array.from(new Uint8Array(await gif.blob().arrayBuffer()));
        }""",
        text,
    )
    decoded = np.asarray(Image.open(io.BytesIO(bytes(made))).convert("RGB")).astype(int)
    apart = abs(decoded - image[..., :3]).max(axis=2)
    assert apart.max() <= (8 if colours <= 256 else 80)
    assert apart.mean() < 20
