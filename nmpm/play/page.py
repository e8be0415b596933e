"""The page: one HTML text, with the viewer's scripts for drawing and this package's for playing."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

VIEWER = "nmpm.viz.viewer"
VIEWER_SCRIPTS = ("data.js", "matrices.js", "drawing.js", "layout.js", "curve.js", "legend.js")
"""Of the viewer: how particles and walls are drawn, and where; what the colours stand for."""
SCRIPTS = ("stage.js", "bodies.js", "pointer.js", "play.js")


@cache
def page() -> str:
    """The page's text."""
    text, style = _read("play.html"), _read("play.css")
    viewer = [_read(name, VIEWER) for name in VIEWER_SCRIPTS]
    for mark, content in {
        "/*STYLE*/": _read("style.css", VIEWER) + style,
        "/*SCRIPT*/": "\n".join([*viewer, *map(_read, SCRIPTS)]),
    }.items():
        before, after = text.split(mark)
        text = before + content + after
    return text


def policy() -> str:
    """The page's content security policy: nothing from elsewhere, and no connection but to where it came from."""
    rules = ("default-src 'none'", "script-src 'unsafe-inline'", "style-src 'unsafe-inline'", "img-src data:")
    closed = ("base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'")
    return "; ".join((*rules, "connect-src 'self'", *closed))


def _read(name: str, package: str = f"{__package__}.page_files") -> str:
    return files(package).joinpath(name).read_text(encoding="utf-8")
