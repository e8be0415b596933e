"""MkDocs hook: links that hold in the repository hold in the site, too.

Pages link to other files by their place in the repository (`../zoo/README.md`); in the site the content of `docs/` is
at the top, with the other included files beside it. Of links to files that the site does not have, the text is left.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
FENCED = re.compile(r"(^ *```.*?^ *```$)", flags=re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\[(?P<text>(?:[^\[\]]|\[[^\]]*\])*)\]\((?!\w+:|#)(?P<target>[^)\s#]+)(?P<anchor>#[^)\s]*)?\)")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrites the relative links of a page; those to notebooks go to their pages."""
    here = os.path.dirname(page.file.src_uri)
    source = ROOT / here if page.file.abs_src_path is None else Path(page.file.abs_src_path).parent

    def rewrite(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(source / link["target"]))
        path = re.sub(r"\.ipynb$", ".md", site_path(target, Path(config.docs_dir)))
        if target.exists() and files.get_file_from_path(path) is None:
            return link["text"]
        return f"[{link['text']}]({os.path.relpath(path, here or '.')}{link['anchor'] or ''})"

    pieces = FENCED.split(markdown)
    return "".join(piece if piece.lstrip().startswith("```") else LINK.sub(rewrite, piece) for piece in pieces)


def site_path(target: Path, docs: Path) -> str:
    """Where a file of the repository is, or would be, in the site."""
    return os.path.relpath(target, docs if target.is_relative_to(docs) else ROOT)
