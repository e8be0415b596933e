"""Run notebooks in empty folders and store their outputs, with digests of their code and of the weights they load.

python benchmarks/run_notebooks.py notebooks/quickstart.ipynb …
"""

from __future__ import annotations

import hashlib
import re
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from timing import make_parser

from nmpm import Zoo

LOAD = re.compile(r'Zoo\.load\("([\w/-]+)"(?:, variant="(\w+)")?')


def main() -> None:
    """Run the notebooks one after the other."""
    parser = make_parser(__doc__)
    parser.add_argument("notebooks", nargs="+", type=Path)
    for path in parser.parse_args().notebooks:
        notebook = nbformat.read(path, as_version=4)
        execute(notebook)
        code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
        notebook.metadata["weights"] = digests(code)
        notebook.metadata["code"] = hashlib.sha256(code.encode()).hexdigest()[:12]
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)  # times of this run
        nbformat.write(notebook, path)
        sys.stdout.write(f"wrote {path}\n")


def execute(notebook: nbformat.NotebookNode) -> None:
    """Replace the outputs of a notebook by those of a run in an empty folder."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "benchmarks").symlink_to(Path(__file__).resolve().parent)  # tables that one of them reads
        (here := Path(folder) / "notebooks").mkdir()
        NotebookClient(notebook, timeout=None, resources={"metadata": {"path": str(here)}}).execute()


def digests(code: str) -> dict[str, str]:
    """The beginning of the SHA-256 of the weights of each shipped model that the code loads."""
    names = {"/".join(filter(None, match)) for match in LOAD.findall(code)} & set(Zoo.list())
    return {name: Zoo.card(name)["sha256"][:12] for name in sorted(names)}


if __name__ == "__main__":
    main()
