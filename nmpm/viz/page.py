"""Pages for browsers: one HTML file without links, for any browser with WebGL 2.

The scripts are the ES modules of the folder `app`, one of which starts each mode: `view` plays what the page contains,
`play` what a server sends, `onnx` what a model in the browser predicts. Positions are unsigned 16-bit numbers.
"""

from __future__ import annotations

import base64
import json
import re
import zlib
from importlib.resources import files
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from nmpm.colours import hex_code
from nmpm.viz.trajectories import Floats

COLOUR_SCALE = "YlGnBu_r"
STEPS = 65534
"""Steps from the lowest to the highest position along an axis: an error of at most 1 / 131068 of the box."""
ABSENT = 65535
"""Stands for the position of a particle that is not there."""

IMPORT = re.compile(r'^import {([^}]*)} from "\./(\w+)\.js";$', re.MULTILINE)
EXPORT = re.compile(r"^export ((?:async )?(?:function|class|const) (\w+))", re.MULTILINE)


def make_page(mode: str, data: dict[str, Any]) -> str:
    """The page of a mode, with data that its scripts read."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    contents = {
        "/*STYLE*/": read_asset("style.css") + read_asset("play.css"),
        "/*SCRIPT*/": bundle(mode),
        "/*DATA*/": text.replace("<", "\\u003c"),  # `</script>` in a text would end the data
    }
    page = read_asset(f"{mode}.html")
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


def colour_scale() -> list[str]:
    """The scale's colours, as #rrggbb."""
    scale = np.round(255 * matplotlib.colormaps[COLOUR_SCALE](np.linspace(0, 1, 64))).astype(int).tolist()
    return [hex_code((red, green, blue)) for red, green, blue, _ in scale]


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
