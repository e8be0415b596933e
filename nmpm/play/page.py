"""The page: one HTML text, with the viewer's scripts for drawing and this package's for playing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files

VIEWER = "nmpm.viz.viewer"
VIEWER_SCRIPTS = ("data.js", "matrices.js", "drawing.js", "layout.js", "curve.js", "legend.js")
"""Of the viewer: how particles and walls are drawn, and where; what the colours stand for."""
SCRIPTS = ("stage.js", "bodies.js", "pointer.js", "play.js")


@cache
def page() -> str:
    """The page's text."""
    return fill(read("play.html"), {"/*SCRIPT*/": scripts(SCRIPTS)})


def fill(text: str, contents: Mapping[str, str]) -> str:
    """A page's text with its style, and with contents in place of their marks."""
    style = read("style.css", VIEWER) + read("play.css")
    for mark, content in {"/*STYLE*/": style, **contents}.items():
        before, after = text.split(mark)
        text = before + content + after
    return text


def scripts(own: Iterable[str]) -> str:
    """The viewer's scripts for drawing, then some of this package's."""
    return "\n".join([*(read(name, VIEWER) for name in VIEWER_SCRIPTS), *map(read, own)])


def policy() -> str:
    """The page's content security policy: nothing from elsewhere, and no connection but to where it came from."""
    rules = ("default-src 'none'", "script-src 'unsafe-inline'", "style-src 'unsafe-inline'", "img-src data:")
    closed = ("base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'")
    return "; ".join((*rules, "connect-src 'self'", *closed))


def read(name: str, package: str = f"{__package__}.page_files") -> str:
    """The text of a file of a package, of this one's page when left out."""
    return files(package).joinpath(name).read_text(encoding="utf-8")
