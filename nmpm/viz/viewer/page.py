"""The viewer's page: one HTML file without links, for any browser with WebGL 2.

Positions are packed as 16-bit differences from frame to frame, deflated, in base64.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from nmpm.colours import hex_code, material_colours
from nmpm.errors import ConfigError
from nmpm.viz.camera import vertical_axis
from nmpm.viz.occupancy import CELL, LEVELS, ensemble_colour
from nmpm.viz.output import check_output, replace_picture
from nmpm.viz.panel import particle_spacing
from nmpm.viz.quantities import quantity_curves
from nmpm.viz.trajectories import Floats, LabelledTrajectories

SCRIPTS = (
    "data.js", "matrices.js", "drawing.js", "density.js", "layout.js", "curve.js", "legend.js", "ensemble.js",
    "gif.js", "saving.js", "pointer.js", "viewer.js",
)  # fmt: skip
COLOUR_SCALE = "YlGnBu_r"
TOP_PERCENTILE = 99.0
"""Of speeds and errors: what the upper end of the colour scale stands for."""
FIELD_PERCENTILES = (0.5, 99.5)
"""Of a field's values: what the ends of the colour scale stand for."""
SAMPLED_FRAMES = 50
STEPS = 65534
"""Steps from the lowest to the highest position along an axis: an error of at most 1 / 131068 of the box."""
MEMBER_STEPS = 16
"""Steps to which positions of further members are rounded: they take half the room, and nobody sees it."""
MEMBER_BYTES = 2**26
"""Largest size of further members' positions before they are deflated; beyond it some particles are left out."""
SPARSE_CELL = 1.4
"""Side of a cell in spacings of the particles on the page where some are left out: the rest have gaps by chance."""
MOST_LEFT_OUT = 40
"""At least one in so many particles of a further member is on the page."""
BAND_TINTS = (0.28, 0.5, 0.75)
"""Share of the ensemble's colour in the bands at `LEVELS`; darker than in pictures, where particles lie over them."""
ABSENT = 65535
"""Stands for the position of a particle that is not there."""


class ViewerPage:
    """A page that plays trajectories; the last expression of a notebook's cell shows it.

    Args:
        trajectories: What to play, side by side or overlaid; errors are against the first.
        every: Shows every so many frames.

    Attributes:
        html: The page's text.

    Raises:
        ConfigError: if `every` is below 1.
    """

    def __init__(self, trajectories: LabelledTrajectories, every: int = 1) -> None:
        if every < 1:
            raise ConfigError(f"every = {every} must be at least 1.")
        data = json.dumps(_describe(trajectories, every), separators=(",", ":"), allow_nan=False)
        contents = {
            "/*STYLE*/": read_asset("style.css"),
            "/*SCRIPT*/": "\n".join(map(read_asset, SCRIPTS)),
            "/*DATA*/": data.replace("<", "\\u003c"),  # `</script>` in a text would end the data
        }
        self.html = fill_page(read_asset("page.html"), contents)

    def write(self, path: Path | str) -> Path:
        """Writes the page to a `.html` file; an existing one is replaced only when the new one is complete.

        Raises:
            ConfigError: if the suffix is another.
            DataError: if the file cannot be written.
        """
        path = Path(path)
        check_output(path, (".html",))
        with replace_picture(path) as temporary:
            temporary.write_text(self.html, encoding="utf-8")
        return path

    def _repr_html_(self) -> str:
        page = html.escape(self.html, quote=True)
        allowed, style = "allow-scripts allow-downloads", "width: 100%; height: 640px; border: 0"
        return f'<iframe srcdoc="{page}" sandbox="{allowed}" style="{style}"></iframe>'


def read_asset(name: str, package: str = __package__) -> str:
    """The text of a file of a package, of the viewer's when left out."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def fill_page(text: str, contents: Mapping[str, str]) -> str:
    """A page's text with contents in place of their marks, each of which stands there once."""
    for mark, content in contents.items():
        before, after = text.split(mark)
        text = before + content + after
    return text


def _describe(trajectories: LabelledTrajectories, every: int) -> dict[str, Any]:
    """All that the page's scripts read, as JSON; speeds and errors in domain lengths, per shown frame."""
    positions = {
        label: trajectories.wrap(position[::every].astype(np.float64))
        for label, position in trajectories.positions.items()
    }
    first, *others = positions.values()
    colours = material_colours(trajectories.materials)
    index = {name: number for number, name in enumerate(colours)}
    sampled = np.unique(np.linspace(0, len(first) - 1, SAMPLED_FRAMES).astype(int))
    moved = [path[sampled[1:]] - path[sampled[1:] - 1] for path in positions.values()]
    return {
        "title": trajectories.title or "nmpm",
        "every": every,
        "dt": trajectories.dt * every,
        "dim": trajectories.dim,
        "bounds": [list(side) for side in trajectories.bounds],
        "domain": [list(side) for side in trajectories.outer_bounds],
        "period": list(trajectories.periods),
        "up": vertical_axis(trajectories),
        "tilt": trajectories.tilt,
        "materials": [{"name": name, "colour": hex_code(colour)} for name, colour in colours.items()],
        "particles": pack_bytes(np.array([index[name] for name in trajectories.material.tolist()], dtype=np.uint8)),
        "scale": colour_scale(),
        "fastest": _nearly_largest(trajectories, moved),
        "worst": _nearly_largest(trajectories, [other[sampled] - first[sampled] for other in others]),
        **_describe_motion(trajectories, positions, every),
        "fields": [_describe_field(trajectories, name, every) for name in trajectories.fields],
        "curves": _describe_curves(trajectories, every),
    }


def colour_scale() -> list[str]:
    """The scale's colours, as #rrggbb."""
    scale = np.round(255 * matplotlib.colormaps[COLOUR_SCALE](np.linspace(0, 1, 64))).astype(int).tolist()
    return [hex_code((red, green, blue)) for red, green, blue, _ in scale]


def _describe_motion(trajectories: LabelledTrajectories, positions: dict[str, Floats], every: int) -> dict[str, Any]:
    """Packed positions, and errors in domain lengths."""
    obstacles = trajectories.obstacles.astype(np.float64)
    longest = max(high - low for low, high in trajectories.outer_bounds)
    spacing = particle_spacing(trajectories.fullest_frame)
    frames, count, dim = next(iter(positions.values())).shape
    room = 2 * frames * count * dim * len(trajectories.further_members)
    stride = min(max(1, -(-room // MEMBER_BYTES)), MOST_LEFT_OUT)
    further = {label: each[::every, ::stride] for label, each in trajectories.further_members.items()}

    def extreme(find: np.ufunc) -> NDArray[np.float64]:
        arrays = np.array(trajectories.outer_bounds).T, obstacles, *positions.values()
        wrapped = (trajectories.wrap(each.astype(np.float64)) for each in further.values())
        ends = [find.reduce(each.reshape(-1, dim), axis=0) for each in (*arrays, *wrapped) if each.size]
        return np.asarray(find.reduce(np.stack(ends), axis=0))

    low, high = extreme(np.fmin), extreme(np.fmax)
    errors = {label: curve[::every] for label, curve in trajectories.rms_errors().items()}
    return {
        "frames": frames,
        "spacing": min(spacing, longest / 20),
        "low": low.tolist(),
        "high": (low + (high - low) * ABSENT / STEPS).tolist(),
        "obstacles": pack_positions(quantize(obstacles, low, high)[None]),
        "trajectories": [
            {
                "label": label,
                "positions": pack_positions(quantize(position, low, high)),
                "errors": [float(f"{error:.6g}") for error in errors.get(label, np.zeros(frames))],
            }
            for label, position in positions.items()
        ],
        "members": [
            {"label": label, "positions": _pack_member(trajectories.wrap(each.astype(np.float64)), low, high)}
            for label, each in further.items()
        ],
        "bands": {
            "stride": stride,
            "cell": (CELL if stride == 1 else SPARSE_CELL) * min(spacing * stride ** (1 / dim), longest / 20),
            "levels": LEVELS,
            "tints": BAND_TINTS,
            "colour": hex_code(ensemble_colour(trajectories.materials)),
        },
    }


def _pack_member(position: Floats, low: NDArray[np.float64], high: NDArray[np.float64]) -> str:
    steps = quantize(position, low, high)
    return pack_positions(np.where(steps == ABSENT, ABSENT, steps // MEMBER_STEPS * MEMBER_STEPS).astype(np.uint16))


def _describe_curves(trajectories: LabelledTrajectories, every: int) -> list[dict[str, Any]]:
    """Derived quantities of an ensemble: of each member, of the truth or null, and bands, the widest first."""

    def rounded(values: NDArray[np.float64]) -> list[float]:
        return [float(f"{value:.4g}") for value in values[::every]]

    return [
        {
            "name": curves.name,
            "members": [rounded(member) for member in curves.members],
            "truth": None if curves.truth is None else rounded(curves.truth),
            "bands": [
                {"percent": round(100 * share), "low": rounded(low), "high": rounded(high)}
                for share, (low, high) in curves.bands().items()
            ],
        }
        for curves in (quantity_curves(trajectories) if trajectories.members else [])
    ]


def _describe_field(trajectories: LabelledTrajectories, name: str, every: int) -> dict[str, Any]:
    """Values as 65535ths of the colour scale, packed like positions; null for a trajectory without the field."""
    by_label = trajectories.fields[name]
    values = np.concatenate([each.ravel() for each in by_label.values()]).astype(np.float64)
    low, high = np.percentile(values[np.isfinite(values)], FIELD_PERCENTILES)
    ends = np.array(low), np.array(high if high > low else low + 1.0)
    shape = trajectories.frame_count, len(trajectories.material)
    packed = {
        label: pack_positions(
            quantize(np.nan_to_num(np.broadcast_to(each, shape)[::every], nan=low).clip(*ends), *ends)
        )
        for label, each in by_label.items()
    }
    shown = [packed.get(label) for label in trajectories.positions]
    return {"name": name, "low": float(ends[0]), "high": float(ends[1]), "values": shown}


def _nearly_largest(trajectories: LabelledTrajectories, differences: list[Floats]) -> float:
    """Nearly the largest length of differences (..., D), the shortest ones where axes are periodic; 1 for none."""
    if not differences:
        return 1.0
    stacked = np.concatenate(differences)
    shortest = [trajectories.shortest(stacked[..., axis], axis) for axis in range(trajectories.dim)]
    lengths = np.sqrt(np.square(shortest).sum(axis=0))
    lengths = lengths[~np.isnan(lengths)]
    return (float(np.percentile(lengths, TOP_PERCENTILE)) if lengths.size else 0.0) or 1.0


def quantize(position: Floats, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Positions (..., D) as multiples of (high - low) / `STEPS` above `low`, (D,) each; NaN as `ABSENT`."""
    return np.where(np.isnan(position), ABSENT, np.round((position - low) / (high - low) * STEPS)).astype(np.uint16)


def pack_positions(steps: NDArray[np.uint16]) -> str:
    """Packs quantised positions (T, N, D), or other numbers (T, N), with particles drawn in this order.

    All low bytes precede all high bytes, which are mostly the same and so take next to no room.
    """
    change = steps.copy()
    change[1:] -= steps[:-1]  # (modulo 65536)
    flat = change.reshape(-1)
    return pack_bytes(np.concatenate([flat & 0xFF, flat >> 8]).astype(np.uint8))


def pack_bytes(values: NDArray[np.uint8]) -> str:
    """Deflated bytes as base64 text."""
    return base64.b64encode(zlib.compress(values.tobytes(), 6)).decode("ascii")
