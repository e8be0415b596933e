"""MkDocs hook: notebooks as pages, with the outputs that are stored in them."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
PICTURES = {"image/png": "png", "image/gif": "gif"}
ESCAPES = re.compile(r"\x1b\[[0-9;]*m")
LONGEST = 60  # lines of an output


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds a page for each notebook, and its pictures."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        text, pictures = render(cells, path.stem)
        for name, content in {f"{path.stem}.md": text, **pictures}.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def render(cells: list[dict[str, Any]], name: str) -> tuple[str, dict[str, bytes]]:
    """The page of a notebook as Markdown, and its pictures by file name."""
    pictures: dict[str, bytes] = {}
    parts = [part for cell in cells for part in _cell(cell, name, pictures)]
    link = f'<a href="{name}.ipynb" download>Download the notebook</a>'
    return "\n\n".join([parts[0], link, *parts[1:]]) + "\n", pictures


def _cell(cell: dict[str, Any], name: str, pictures: dict[str, bytes]) -> Iterator[str]:
    source = "".join(cell["source"])
    if cell["cell_type"] != "code":
        yield source
        return
    yield f"```python\n{source}\n```"
    for output in cell["outputs"]:
        data = output.get("data", {})
        shown = next((kind for kind in PICTURES if kind in data), None)
        if shown:
            file = f"{name}-{len(pictures) + 1}.{PICTURES[shown]}"
            pictures[file] = base64.b64decode("".join(data[shown]))
            yield f"![output]({file})"
        elif text := "".join(output.get("text", data.get("text/plain", ""))).rstrip():
            yield _text(ESCAPES.sub("", text))


def _text(text: str) -> str:
    lines = text.splitlines()
    kept = lines if len(lines) <= LONGEST else [*lines[:LONGEST], "…"]
    return "\n".join(["```text", *kept, "```"])
