"""The site's page that plays a model in the browser, in headless Chromium.

`NMPM_ONNXRUNTIME_WEB` names the folder of ONNX Runtime's files: node_modules/onnxruntime-web/dist, of the version that
docs/hooks/play.py states; without it nothing is run but the start.
"""

import base64
import functools
import http.server
import json
import os
import re
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest

from nmpm import Zoo
from nmpm._support.messages import install
from nmpm.viz.page import make_page
from tests.conftest import wait_until
from tests.test_site import load_hook

RUNTIME = "runtime/"
CELLS = 1e-3  # largest difference from Python's rollout over a bundle: what `nmpm export` allows, too
pytest.importorskip("mkdocs", reason=install("docs"))


@pytest.fixture(scope="module")
def hook():
    return load_hook("play")


@pytest.fixture
def open_page(visit):
    return lambda address: visit(address, "window.session && session.page.drawn > 0", 600, 600)


def test_from_the_file_system_the_page_says_what_it_needs(hook, open_page, tmp_path):
    page = make_page("onnx", hook.described(Zoo.load(hook.MODEL), RUNTIME))
    (tmp_path / "index.html").write_text(page, encoding="utf-8")
    page = open_page((tmp_path / "index.html").as_uri())
    assert "python -m http.server" in page.locator("#start").inner_text()
    assert page.locator("#start").is_disabled()


def test_the_version_is_the_same_everywhere(hook):
    settings = (Path(__file__).parent.parent / "mkdocs.yml").read_text("utf-8")
    assert re.findall(r"onnxruntime-web@([\d.]+)/", settings) == [hook.VERSION]


@pytest.fixture(scope="module")
def runtime():
    """The folder of ONNX Runtime's files."""
    folder = os.environ.get("NMPM_ONNXRUNTIME_WEB")
    if not folder:
        pytest.skip("NMPM_ONNXRUNTIME_WEB does not name the folder of onnxruntime-web's files")
    pytest.importorskip("onnxscript", reason=install("export"))
    return Path(folder)


@pytest.fixture(scope="module")
def address(hook, runtime, tmp_path_factory):
    """Where the page is served."""
    folder = tmp_path_factory.mktemp("page")
    (folder / RUNTIME).mkdir()
    for name, _ in hook.RUNTIME:
        shutil.copyfile(runtime / name, folder / RUNTIME / name)
    for name, content in hook.page_files(RUNTIME).items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    handler = functools.partial(Quiet, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever).start()
    yield f"http://127.0.0.1:{server.server_port}/index.html"
    server.shutdown()
    server.server_close()


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


def wait_long(page, condition):
    """Waits where WebAssembly of 14 MB is compiled, or the model is called."""
    page.wait_for_function(condition, timeout=100_000)


def numbers(page, what):
    return np.array(page.evaluate(f"Array.from({what})"))


def at(page, point):
    """Pixels of the window at a point of the scene."""
    x, y, *_ = page.evaluate(f"session.page.pixelOf({json.dumps(point)})")
    box = page.locator("#scene").bounding_box()
    return box["x"] + x, box["y"] + y


@pytest.mark.timeout(600)
def test_the_page_plays_as_python_does_and_takes_blocks(hook, address, open_page):
    page = open_page(address)
    page.click("#play")
    page.click("#start")
    wait_long(page, "session.next")
    model = Zoo.load(hook.MODEL)
    state, bounds = model.example(hook.SEED), np.array(model.scene.bounds)
    frames, count = model.emulator.frames, state.position.shape[1]
    expected = model.rollout(state, frames)[0].numpy()
    first = numbers(page, "session.next.positions").reshape(frames, count, 2)
    assert np.abs(first - expected).max() < CELLS * min(model.emulator.grid.spacing)

    page.click("#step")
    assert page.evaluate("[session.frame, session.index, session.bundle.count]") == [1, 0, count]
    low = bounds[:, 0] + 0.1
    page.mouse.move(*at(page, low.tolist()))
    page.mouse.down()
    page.mouse.move(*at(page, (low + np.array((0.1, 0.2))).tolist()), steps=3)
    page.mouse.up()
    assert page.evaluate("session.waiting.length") == 1
    page.click("#play")
    wait_long(page, f"session.bundle.count > {count}")
    assert page.evaluate("session.waiting.length") == 0
    wait_long(page, f"session.frame > {6 * frames}")
    shown = numbers(page, "session.bundle.positions").reshape(frames, -1, 2)
    assert np.isfinite(shown).all()
    assert (shown >= bounds[:, 0] - 1e-6).all()
    assert (shown <= bounds[:, 1] + 1e-6).all()
    page.click("#restart")
    wait_long(page, f"session.bundle.count === {count}")


def test_another_file_than_the_pinned_one_is_not_run(hook, address, browser):
    page = browser.new_page()
    page.route(f"**/{hook.RUNTIME[0][0]}", lambda route: route.fulfill(body="export const env = {}"))
    page.goto(address)
    page.click("#start")
    wait_until(page, "!document.getElementById('say').hidden")
    assert "not the file that this page expects" in page.locator("#say").inner_text()
    page.close()


def test_the_start_is_the_models_example(hook):
    model = Zoo.load(hook.MODEL)
    start = hook.described(model, RUNTIME)["start"]
    position = np.frombuffer(base64.b64decode(start["position"]), "<f4").reshape(-1, 2)
    np.testing.assert_array_equal(position, model.example(hook.SEED).position[0].numpy())
