"""MkDocs hook: blocks of mathematics as pictures in the page, drawn by Matplotlib when the site is built.

A block is fenced as ```math and written in the part of TeX that Matplotlib knows. No script or font is fetched.
"""

from __future__ import annotations

import html
import io
import re

import matplotlib as mpl
from matplotlib.figure import Figure
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

BLOCK = re.compile(r"^( *)```math\n(.*?)\n *```$", flags=re.DOTALL | re.MULTILINE)
STYLE = {"mathtext.fontset": "cm", "svg.fonttype": "path", "svg.hashsalt": "nmpm"}
SIZE = 13  # points


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001 (a hook)
    """Replaces the blocks."""
    return BLOCK.sub(lambda block: block[1] + drawing(block[2]), markdown)


def drawing(formulas: str) -> str:
    """HTML of formulas, one to a line; screen readers read their TeX."""
    lines = [line.strip() for line in formulas.splitlines() if line.strip()]
    pictures = "".join(svg(line) for line in lines)
    return f'<div class="mathematics" role="img" aria-label="{html.escape(formulas)}">{pictures}</div>'


def svg(formula: str) -> str:
    """An SVG element that is as large as its formula."""
    figure, file = Figure(), io.StringIO()
    figure.patch.set_visible(False)
    figure.text(0, 0, f"${formula}$", fontsize=SIZE)
    with mpl.rc_context(STYLE):
        figure.savefig(file, format="svg", bbox_inches="tight", pad_inches=0.03, metadata={"Date": None})
    element = re.sub(r"<metadata>.*?</metadata>", "", file.getvalue(), flags=re.DOTALL)
    return re.sub(r"\s*\n\s*", " ", element[element.index("<svg") :])
