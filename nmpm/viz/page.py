"""Pages for browsers: one HTML file without links, for any browser with WebGL 2.

There is one template, `app/page.html`, and one script for each of its modes, the ES module of that name in `app` with
all that it imports: `view` plays what the page contains, `socket` what a server sends, `onnx` what a model in the
browser predicts. All read one description of the scene, of `describe_scene`, and positions that are unsigned 16-bit
numbers.
"""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from nmpm.colours import hex_code, material_colours
from nmpm.scene import Interval
from nmpm.viz.trajectories import Floats

COLOUR_SCALE = "YlGnBu_r"
STEPS = 65534
"""Steps from the lowest to the highest position along an axis: an error of at most 1 / 131068 of the box."""
ABSENT = 65535
"""Stands for the position of a particle that is not there."""

IMPORT = re.compile(r'^import {([^}]*)} from "\./(\w+)\.js";$', re.MULTILINE)
EXPORT = re.compile(r"^export ((?:async )?(?:function|class|const) (\w+))", re.MULTILINE)
ONLY = re.compile(r"<!-- only ([a-z ]+) -->\n?(.*?)<!-- end -->\n?", re.DOTALL)


def make_page(mode: str, data: Mapping[str, Any]) -> str:
    """The page of a mode, which reads this data."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    contents = {
        "/*STYLE*/": read_asset("style.css"),
        "/*SCRIPT*/": bundle(mode),
        "/*DATA*/": text.replace("<", "\\u003c"),  # `</script>` in a text would end the data
    }
    page = ONLY.sub(lambda part: part[2] if mode in part[1].split() else "", read_asset("page.html"))
    for mark, content in contents.items():
        before, after = page.split(mark)
        page = before + content + after
    return page


def bundle(entry: str) -> str:
    """A module and all that it imports as one script: each in a function of its own, after those that it imports.

    Browsers import no modules from files that are opened by a double click, so that a page has to contain them.
    """
    scripts: dict[str, str] = {}

    def add(name: str) -> None:
        if name in scripts:
            return
        text = read_asset(f"{name}.js")
        for _, imported in IMPORT.findall(text):
            add(imported)
        exported = ", ".join(each for _, each in EXPORT.findall(text))
        text = EXPORT.sub(r"\1", IMPORT.sub(r"const {\1} = modules.\2;", text))
        scripts[name] = f"modules.{name} = (() => {{\n{text}\nreturn {{ {exported} }};\n}})();"

    add(entry)
    return "\n".join(["const modules = {};", *scripts.values()])


def read_asset(name: str) -> str:
    """The text of a file of the folder `app`."""
    return files("nmpm.viz").joinpath("app", name).read_text(encoding="utf-8")


def describe_scene(
    *,
    title: str,
    bounds: Sequence[Interval],
    domain: Sequence[Interval],
    period: Sequence[float],
    up: int,
    dt: float,
    spacing: float,
    materials: Iterable[str],
    obstacles: Floats,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    **facts: Any,
) -> dict[str, Any]:
    """The scene as the scripts of all modes read it, in domain length, and further facts of one mode.

    Args:
        title: Of the page.
        bounds: Region of the particles, (lower, upper) per axis.
        domain: Outer side of the walls, (lower, upper) per axis.
        period: Length along periodic axes, 0 along the others.
        up: Axis that is drawn vertically.
        dt: Seconds between two frames.
        spacing: Between particles.
        materials: Names, to which the particles' indices point.
        obstacles: (M, D) positions of particles that do not move.
        low: (D,) lowest position that is shown.
        high: (D,) highest position that is shown.
        facts: Of one mode.
    """
    scale = np.round(255 * matplotlib.colormaps[COLOUR_SCALE](np.linspace(0, 1, 64))).astype(int).tolist()
    return {
        "title": title,
        "dim": len(bounds),
        "bounds": bounds,
        "domain": domain,
        "period": period,
        "up": up,
        "dt": dt,
        "spacing": spacing,
        "materials": [{"name": name, "colour": hex_code(rgb)} for name, rgb in material_colours(materials).items()],
        "scale": [hex_code((red, green, blue)) for red, green, blue, _ in scale],
        "low": low.tolist(),
        "high": (low + (high - low) * ABSENT / STEPS).tolist(),
        "obstacles": pack_positions(quantize(obstacles.astype(np.float64), low, high)[None]),
        "frames": 1,
        "fields": [],
        **facts,
    }


def quantize(position: Floats, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Positions (..., D) as multiples of (high - low) / `STEPS` above `low`, (D,) each; NaN as `ABSENT`."""
    return np.where(np.isnan(position), ABSENT, np.round((position - low) / (high - low) * STEPS)).astype(np.uint16)


def pack_positions(steps: NDArray[np.uint16]) -> str:
    """Packs quantised positions (T, N, D), or other numbers (T, N), with particles drawn in this order.

    All low bytes precede all high bytes, which are mostly the same and so take next to no room.
    """
    change = steps.copy()
    change[1:] -= steps[:-1]  # (modulo 65536)
    flat = change.reshape(-1)
    return pack_bytes(np.concatenate([flat & 0xFF, flat >> 8]).astype(np.uint8))


def pack_bytes(values: NDArray[np.uint8]) -> str:
    """Deflated bytes as base64 text."""
    return base64.b64encode(zlib.compress(values.tobytes(), 6)).decode("ascii")
