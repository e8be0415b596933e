"""Measure `nmpm play` in headless Chromium: pictures, input to picture, and the server's processor time.

python benchmarks/playing.py                       waterramps: playing, dragging a ramp, pouring, 8 s each
python benchmarks/playing.py goop --seconds 20

On Linux, with Playwright and Chromium installed. The browser draws with the CPU, so that it takes its share of the
machine; processor times are the server's alone. A row gives particles; refreshes of the page's screen and pictures of
the scene per second; how long pictures stay (median, 95 of 100, longest), and the time from an input to the picture
that shows it (median, 95 of 100).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from playwright.sync_api import Page, sync_playwright
from timing import describe_machine, make_parser

OPTIONS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic")
PROBE = """() => {
  const probe = window.probe = { refreshes: 0, drawn: [], waiting: [], answered: [], arrived: [], delays: [] };
  const wrap = (object, name, before) => {
    const method = object[name].bind(object);
    object[name] = (...values) => { before(...values); return method(...values); };
  };
  wrap(play, "send", ({ do: what }) => { if (what === "move") probe.waiting.push(performance.now()); });
  wrap(play, "read", ({ bodies }) => { if (bodies) probe.answered.push(probe.waiting.shift()); });
  wrap(play, "takeFrame", (predictor) => {
    if (predictor === 0) probe.arrived.push(...probe.answered.splice(0));
  });
  wrap(play, "onDrawn", () => {
    if (play.picture === play.acknowledged) return;
    const now = performance.now();
    probe.drawn.push(now);
    probe.delays.push(...probe.arrived.splice(0).filter(Boolean).map((sent) => now - sent));
  });
  const refreshed = () => { probe.refreshes++; requestAnimationFrame(refreshed); };
  refreshed();
}"""
MOVE_ABOUT = """([x, y]) => {
  const started = performance.now(), canvas = document.getElementById("scene");
  window.moving = setInterval(() => {
    const angle = (performance.now() - started) / 300;
    const at = { clientX: x + 40 * Math.sin(angle), clientY: y + 25 * Math.sin(2 * angle), bubbles: true };
    canvas.dispatchEvent(new PointerEvent("pointermove", at));
  }, 10);
}"""


def main() -> None:
    """Play in a browser, and measure."""
    parser = make_parser(__doc__)
    parser.add_argument("model", nargs="?", default="waterramps")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each row (default: 8)")
    parser.add_argument("--seed", type=int, default=1, help="of the scene (default: 1)")
    options = parser.parse_args()
    command = [sys.executable, "-m", "nmpm", "play", options.model, "--seed", str(options.seed), "--no-browser"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        address = server.stdout.readline().split()[-1]
        with sync_playwright() as running:
            chromium = running.chromium.launch(
                executable_path=shutil.which("chromium") or shutil.which("google-chrome"), args=list(OPTIONS)
            )
            page = chromium.new_page(viewport={"width": 400, "height": 480})
            page.goto(address)
            page.wait_for_timeout(6000)  # kernels are compiled, or read from the cache
            page.evaluate(PROBE)
            measure(page, server.pid, 1000 * options.seconds)
            chromium.close()
    finally:
        server.terminate()
        server.wait()


def measure(page: Page, server: int, milliseconds: float) -> None:
    """Print a row for each way of playing."""
    print(describe_machine(torch.device("cpu"), 1))
    for name, begin in (("playing", lambda _: None), ("dragging", drag), ("pouring", pour)):
        restart(page)
        begin(page)
        page.evaluate("for (const name of ['drawn', 'delays']) probe[name] = []; probe.refreshes = 0")
        before = processor_seconds(server)
        page.wait_for_timeout(milliseconds)
        spent = processor_seconds(server) - before
        result = page.evaluate("({...probe, count: play.films[0].position.length / play.camera.centre.length})")
        page.evaluate("clearInterval(window.moving)")
        page.mouse.up()
        print(row(name, result, spent, milliseconds / 1000), flush=True)


def restart(page: Page) -> None:
    """Start anew, and wait a little."""
    page.keyboard.press("r")
    page.wait_for_timeout(1000)


def press(page: Page, point: list[float]) -> list[float]:
    """Press the pointer at a point of the scene; where that is in the window."""
    x, y = page.evaluate("(point) => play.pixelOf(point).slice(0, 2)", point)
    box = page.locator("#scene").bounding_box() or {}
    at = [box["x"] + x, box["y"] + y]
    page.mouse.move(*at)
    page.mouse.down()
    return at


def drag(page: Page) -> None:
    """Begin to move the first body about."""
    page.evaluate(MOVE_ABOUT, press(page, page.evaluate("play.bodies[0].centre")))


def pour(page: Page) -> None:
    """Begin to pour."""
    page.keyboard.press("p")
    press(page, [0.5, 0.85])


def processor_seconds(process: int) -> float:
    """Of all threads of a process so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def row(name: str, result: dict[str, Any], spent: float, seconds: float) -> str:
    """A row of the output."""
    pictures, load = len(result["drawn"]), os.getloadavg()[0]
    stay, delay = (spread(values) for values in (np.diff(result["drawn"]), result["delays"]))
    return (
        f"{name:9} {result['count']} particles, {result['refreshes'] / seconds:.0f} refreshes/s,"
        f" {pictures / seconds:.1f} pictures/s, each {stay} ms; input to picture {delay} ms;"
        f" server {1000 * spent / pictures:.1f} ms CPU a picture, {spent / seconds:.2f} cores; load {load:.1f}"
    )


def spread(values: Any) -> str:
    """Median, 95 of 100 and longest."""
    return " / ".join(f"{value:.0f}" for value in np.quantile(values, (0.5, 0.95, 1))) if len(values) else "–"


if __name__ == "__main__":
    main()
