"""MkDocs hook: boxes as GitHub shows them (`> [!WARNING]`) are boxes in the site, too."""

from __future__ import annotations

import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

BOX = re.compile(r"^> \[!(\w+)\]\n((?:>.*\n?)+)", flags=re.MULTILINE)


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001 (a hook)
    """Replaces the boxes."""
    return BOX.sub(lambda box: f"!!! {box[1].lower()}\n\n" + re.sub(r"^> ?", "    ", box[2], flags=re.M), markdown)
