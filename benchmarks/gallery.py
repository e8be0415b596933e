"""Simulate and draw one trajectory of every shipped scene, stacked into one picture.

python benchmarks/gallery.py docs/scenes.png [--seed 3] [--frames 400]

The slowest scenes take a minute or more; --only names the scenes to draw.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from timing import make_parser

from nmpm.sim import load_preset, preset_names


def main() -> None:
    """Simulate and draw each scene, and stack the pictures."""
    parser = make_parser(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--frames", type=int, help="of each scene, at most")
    parser.add_argument("--only", nargs="+", default=list(preset_names()))
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        drawn = [_draw(name, chosen.seed, chosen.frames, Path(folder)) for name in chosen.only]
        _stack(drawn).save(chosen.out, optimize=True)
    sys.stdout.write(f"wrote {chosen.out}\n")


def _draw(name: str, seed: int, frames: int | None, folder: Path) -> Image.Image:
    path = folder / f"{name}.png"
    length = min(load_preset(name).frames, frames or sys.maxsize)
    words = ["simulate", name, "--preview", str(path), "--seed", str(seed), "--frames", str(length)]
    subprocess.run([sys.executable, "-m", "nmpm", *words], check=True)
    with Image.open(path) as picture:
        return picture.convert("RGB")


def _stack(pictures: list[Image.Image], width: int = 1200) -> Image.Image:
    scaled = [picture.resize((width, round(picture.height * width / picture.width))) for picture in pictures]
    whole = Image.new("RGB", (width, sum(picture.height for picture in scaled)), "white")
    top = 0
    for picture in scaled:
        whole.paste(picture, (0, top))
        top += picture.height
    return whole.quantize(128)


if __name__ == "__main__":
    main()
