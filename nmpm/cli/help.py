"""How the help of commands is laid out."""

from __future__ import annotations

import argparse
import textwrap


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Fills prose to the terminal's width; paragraphs with indented lines, as examples are, stay as written."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = text.strip("\n").split("\n\n")
        filled = [
            paragraph if "\n " in paragraph or paragraph.startswith(" ") else textwrap.fill(paragraph, width)
            for paragraph in paragraphs
        ]
        return textwrap.indent("\n\n".join(filled), indent) + "\n"
