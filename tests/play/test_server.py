"""The server's doors, and the page in headless Chromium."""

import asyncio
import http.client
import json
import threading
import time

import pytest

pytest.importorskip("websockets", reason="websockets is not installed")
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from nmpm.play.server import HOST, PlayServer, play
from nmpm.play.session import Session
from tests.conftest import wait_until
from tests.play.conftest import model_of


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A server that plays, in a thread."""
    session = Session(model_of("waterramps"), 1, tmp_path_factory.mktemp("played") / "played.h5")
    server, ready = PlayServer(session), threading.Event()
    loop = asyncio.new_event_loop()
    task = loop.create_task(play(server, lambda address: ready.set()))

    def run():
        with pytest.raises(asyncio.CancelledError):
            loop.run_until_complete(task)

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(30)
    yield server
    loop.call_soon_threadsafe(task.cancel)
    thread.join(30)
    session.close()


def get(server, path, host=None):
    connection = http.client.HTTPConnection(HOST, server.port, timeout=30)
    connection.request("GET", path, headers={"Host": host or f"{HOST}:{server.port}"})
    answer = connection.getresponse()
    return answer.status, answer.read().decode(), answer.headers


def socket(server, token=None, origin=None):
    address = f"ws://{HOST}:{server.port}/{token or server.token}/socket"
    return connect(address, origin=origin or f"http://{HOST}:{server.port}", max_size=2**22, open_timeout=30)


def read_all(page):
    while True:
        page.recv(timeout=30)


def test_the_page_needs_the_token_and_the_name_of_this_machine(server):
    status, text, headers = get(server, f"/{server.token}/")
    assert status == 200
    assert "nmpm play" in text
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    for path in ("/", "/x/", f"/{server.token}", f"/{server.token}x/", "/%c3%a9/"):
        assert get(server, path)[0] == 404
    assert get(server, f"/{server.token}/", host="evil.example")[0] == 403


@pytest.mark.parametrize("name", ["Host", "Origin"])
def test_a_header_that_is_stated_twice_is_a_bad_request(server, name):
    connection = http.client.HTTPConnection(HOST, server.port, timeout=30)
    connection.putrequest("GET", f"/{server.token}/", skip_host=True)
    for host in (f"{HOST}:{server.port}", "evil.example"):
        connection.putheader(name, host)
    connection.endheaders()
    assert connection.getresponse().status == 400


def test_the_socket_needs_the_token_and_the_page(server):
    for changes in ({"token": "wrong"}, {"origin": "http://evil.example"}):
        with pytest.raises(InvalidStatus):
            socket(server, **changes)
    with socket(server) as page:
        assert "scene" in json.loads(page.recv(timeout=30))


def test_only_this_machine_is_served(server):
    assert {address[0] for address in server.listening_at} == {"127.0.0.1"}


def test_long_messages_and_floods_end_nothing(server):
    with socket(server) as page:
        page.send("x" * 100_000)
        with pytest.raises(ConnectionClosed):
            read_all(page)
    with socket(server) as page:
        for _ in range(300):
            page.send("{}")
        assert any("has no" in text for text in iter(lambda: page.recv(timeout=30), None) if isinstance(text, str))


def test_another_page_takes_over(server):
    with socket(server) as first, socket(server) as second:
        with pytest.raises(ConnectionClosed) as closed:
            read_all(first)
        assert "another window" in str(closed.value)
        assert "scene" in json.loads(second.recv(timeout=30))


@pytest.fixture
def page(visit, server):
    return visit(server.address, "window.play && play.drawn > 2", 500, 500)


def at(page, point):
    """Pixels of the window at a point of the scene."""
    x, y, *_ = page.evaluate(f"play.pixelOf({json.dumps(point)})")
    box = page.locator("#scene").bounding_box()
    return box["x"] + x, box["y"] + y


def drag(page, start, end):
    page.mouse.move(*at(page, start))
    page.mouse.down()
    page.mouse.move(*at(page, end), steps=4)
    page.mouse.up()


def test_start_throw_drag_pour_close(page, server):
    page.click("#restart")
    page.evaluate("play.send({do: 'play', on: false})")
    wait_until(page, "play.films[0].frame < 5")
    count = page.evaluate("play.films[0].position.length")
    drag(page, [0.15, 0.85], [0.2, 0.85])
    wait_until(page, f"play.films[0].position.length > {count}")
    body = page.evaluate("play.bodies[0]")
    goal = [0.5, 0.6]
    drag(page, body["centre"], goal)
    wait_until(page, f"Math.abs(play.bodies[0].centre[1] - {goal[1]}) < 0.02")
    page.select_option("#colour", "speed")
    legend = (
        "Array.from(document.querySelector('#legend canvas').getContext('2d').getImageData(0, 0, 1, 1).data).join()"
    )
    before = page.evaluate(legend)
    page.keyboard.press("t")
    wait_until(page, f"{legend} !== '{before}'")  # the scale is the theme's
    page.keyboard.press("t")
    page.keyboard.press("p")
    page.keyboard.press(" ")
    count = page.evaluate("play.films[0].position.length")
    page.mouse.move(*at(page, [0.85, 0.85]))
    page.mouse.down()
    wait_until(page, f"play.films[0].position.length > {count}")
    page.mouse.up()
    wait_until(page, "document.getElementById('pictures').textContent.includes('pictures/s')")
    page.close()
    assert get(server, f"/{server.token}/")[0] == 200  # another page may be opened


def test_a_body_comes_to_rest_under_the_pointer_that_holds_it(page, server):
    body = page.evaluate("play.bodies[0]")
    page.mouse.move(*at(page, body["centre"]))
    page.mouse.down()
    for goal in ([0.45, 0.6], [0.5, 0.7]):  # faster than moves are sent
        page.mouse.move(*at(page, goal))
    wait_until(page, "play.bodies[0].centre[1] > 0.68")
    wait_for(lambda: abs(server.session.world.bodies[body["id"]].centre[1] - 0.7) < 0.01)
    page.mouse.up()


def wait_for(condition):
    for _ in range(800):
        if condition():
            return
        time.sleep(0.025)
    pytest.fail("not within 20 s")


def test_the_page_says_what_was_wrong(page):
    page.evaluate("play.send({do: 'restart', seed: -1})")
    wait_until(page, "!document.getElementById('say').hidden")
    assert "seed = -1" in page.locator("#say").inner_text()
