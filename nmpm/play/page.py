"""The page: one HTML text, with the viewer's scripts for drawing and this package's for playing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache

from nmpm.viz.viewer.page import fill_page, read_asset

FILES = f"{__package__}.page_files"
VIEWER_SCRIPTS = ("data.js", "matrices.js", "drawing.js", "layout.js", "curve.js", "legend.js")
"""Of the viewer: how particles and walls are drawn, and where; what the colours stand for."""
SCRIPTS = ("stage.js", "bodies.js", "pointer.js", "play.js")


@cache
def page() -> str:
    """The page's text."""
    return fill(read_asset("play.html", FILES), {"/*SCRIPT*/": scripts(SCRIPTS)})


def fill(text: str, contents: Mapping[str, str]) -> str:
    """A page's text with its style, and with contents in place of their marks."""
    return fill_page(text, {"/*STYLE*/": read_asset("style.css") + read_asset("play.css", FILES), **contents})


def scripts(own: Iterable[str]) -> str:
    """The viewer's scripts for drawing, then some of this package's."""
    return "\n".join([*map(read_asset, VIEWER_SCRIPTS), *(read_asset(name, FILES) for name in own)])


def policy() -> str:
    """The page's content security policy: nothing from elsewhere, and no connection but to where it came from."""
    rules = ("default-src 'none'", "script-src 'unsafe-inline'", "style-src 'unsafe-inline'", "img-src data:")
    closed = ("base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'")
    return "; ".join((*rules, "connect-src 'self'", *closed))
