"""Self-contained pages: one HTML file with style, scripts and data in it, and without links."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources.abc import Traversable
from typing import Any


def fill_page(folder: Traversable, scripts: Sequence[str], data: Any) -> str:
    """The text of `page.html` with `style.css`, the scripts and the data in the places that it marks.

    Args:
        folder: Holds these files.
        scripts: Names of the scripts, in order.
        data: What JSON can hold; the page reads it from its element `data`.
    """
    # `</script>` in a text would end the data.
    packed = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    script = "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in scripts)
    style = folder.joinpath("style.css").read_text(encoding="utf-8")
    page = folder.joinpath("page.html").read_text(encoding="utf-8")
    for mark, content in {"/*STYLE*/": style, "/*SCRIPT*/": script, "/*DATA*/": packed}.items():
        before, after = page.split(mark)
        page = before + content + after
    return page
