"""Draw the README's film: scenes by the simulator, and below them by the zoo's models, with the time of a frame.

nmpm demo dambreak2d --frames 400 --seed 1 --no-open --out dambreak2d
nmpm demo waterramps --frames 400 --seed 1 --no-open --out waterramps
python benchmarks/film.py docs/film.gif dambreak2d.h5 waterramps.h5

Files are named after their models. The times are the ones that `nmpm trade` measured on a machine that did nothing else
(CPU time): of the model as `Zoo.load` gives it, of the simulator as drawn, its shipped setting, and of the simulator at
equal error, its cheapest stable setting whose full rollouts are no less accurate than the model's.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from timing import make_parser

from nmpm.colours import BACKGROUND, FAINT_TEXT, OBSTACLE, TEXT, Rgb, material_colours
from nmpm.data.format import Split
from nmpm.evaluation.trade.ranking import Setting, at_equal_error
from nmpm.viz.animation import _write_gif
from nmpm.viz.files import read_labelled
from nmpm.viz.panel import PanelRenderer

FONTS = Path(mpl.get_data_path()) / "fonts" / "ttf"
FONT, BOLD = (ImageFont.truetype(FONTS / name, 14) for name in ("DejaVuSans.ttf", "DejaVuSans-Bold.ttf"))
MARGIN, TITLE, HEADER = 10, 26, 24


class Column:
    """A scene: the simulator above the model, in panels of one height."""

    def __init__(self, file: Path, height: int) -> None:
        trajectories = read_labelled(Split(file))
        (left, right), (bottom, top) = trajectories.outer_bounds
        self.panel = PanelRenderer(trajectories, round(height * (right - left) / (top - bottom)))
        self.positions = tuple(trajectories.positions.values())
        self.name = file.stem
        shipped, equal, model = _milliseconds(file.stem)
        self.times = (f"{equal:.2g} – {shipped:.2g} ms", f"{model:.2g} ms")

    def draw(self, image: Image.Image, left: int, frame: int) -> None:
        """Draws the column with its texts, from this pixel on."""
        draw, right = ImageDraw.Draw(image), left + self.panel.width
        draw.text((left, TITLE - 8), self.name, TEXT, BOLD, anchor="ls")
        draw.text((right, TITLE - 8), f"{self.positions[0].shape[1]:,} particles", FAINT_TEXT, FONT, anchor="rs")
        for row, label in enumerate(("simulator", "model")):
            top = TITLE + HEADER + row * (HEADER + self.panel.height)
            draw.text((left, top - 7), label, TEXT, FONT, anchor="ls")
            draw.text((right, top - 7), self.times[row], FAINT_TEXT, FONT, anchor="rs")
            image.paste(Image.fromarray(self.panel.draw(self.positions[row][frame])), (left, top))


@dataclass(frozen=True)
class Film:
    """Columns side by side, drawn as `FrameRenderer` draws trajectories."""

    columns: Sequence[Column]

    @property
    def colours(self) -> list[Rgb]:
        """Those that the palette keeps."""
        materials = [name for column in self.columns for name in column.panel.trajectories.materials]
        return [*material_colours(tuple(dict.fromkeys(materials))).values(), OBSTACLE]

    def draw(self, frame: int) -> NDArray[np.uint8]:
        """One frame, (height, width, 3)."""
        width = MARGIN + sum(column.panel.width + MARGIN for column in self.columns)
        height = TITLE + 2 * (HEADER + self.columns[0].panel.height) + MARGIN
        image, left = Image.new("RGB", (width, height), BACKGROUND), MARGIN
        for column in self.columns:
            column.draw(image, left, frame)
            left += column.panel.width + MARGIN
        return np.asarray(image)


def main() -> None:
    """Draw rollouts that have the truth beside them."""
    parser = make_parser(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--height", type=int, default=210, help="of a panel, in pixels")
    parser.add_argument("--frames", type=int, default=60, help="frames of the film")
    options = parser.parse_args()
    film = Film([Column(file, options.height) for file in options.files])
    last = min(len(column.positions[0]) for column in film.columns) - 1
    _write_gif(film, np.linspace(0, last, options.frames).astype(int).tolist(), 12.5, options.out)
    sys.stdout.write(f"wrote {options.out}: {options.out.stat().st_size / 1e6:.2f} MB\n")


def read_trade(dataset: str) -> list[dict[str, str]]:
    """The choices of a stored table of `nmpm trade`, with the MSE of their full rollouts as `value`."""
    with (Path(__file__).parent / "trade" / dataset / "trade.csv").open(encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["error"] == "mse"]


def simulator_settings(rows: Sequence[Mapping[str, str]]) -> list[Setting]:
    """The simulator's stable settings, the shipped one first."""
    stable = [row for row in rows if row["kind"] == "simulator" and row["stable"] == "True"]
    return [Setting(row["name"], float(row["ms_per_frame"]), float(row["value"])) for row in stable]


def _milliseconds(name: str) -> tuple[float, float, float]:
    """Of a frame by the simulator's shipped setting, by the one at equal error, and by the model."""
    rows = read_trade(name)
    settings, model = simulator_settings(rows), next(row for row in rows if row["kind"] == "model")
    equal = at_equal_error(settings, float(model["value"])) or settings[0]
    return settings[0].milliseconds, equal.milliseconds, float(model["ms_per_frame"])


if __name__ == "__main__":
    main()
