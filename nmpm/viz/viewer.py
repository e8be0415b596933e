"""A viewer for browsers: one self-contained HTML page that plays trajectories, drawn by WebGL.

`view` is what notebooks call; `nmpm view` writes the page to a file.
"""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.colours import hex_code
from nmpm.errors import ConfigError
from nmpm.viz.camera import vertical_axis
from nmpm.viz.ensembles import CELL, LEVELS, ensemble_colour, quantity_curves
from nmpm.viz.output import check_output, replace_picture
from nmpm.viz.page import ABSENT, describe_scene, make_page, pack_bytes, pack_positions, quantize
from nmpm.viz.panel import particle_spacing
from nmpm.viz.trajectories import Floats, LabelledTrajectories

__all__ = ["ViewerPage", "page_of_files", "view"]

TOP_PERCENTILE = 99.0
"""Of speeds and errors: what the upper end of the colour scale stands for."""
FIELD_PERCENTILES = (0.5, 99.5)
"""Of a field's values: what the ends of the colour scale stand for."""
SAMPLED_FRAMES = 50
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


def view(what: LabelledTrajectories | Path | str, truth: Path | str | None = None, every: int = 1) -> ViewerPage:
    """A page that plays trajectories; as the last expression of a notebook's cell it appears below it.

    Args:
        what: Labelled trajectories, or a file or folder of data, whose first trajectory (of the tests, if there are
            any) is shown.
        truth: Data whose first trajectory starts in the same way; errors are against it.
        every: Shows every so many frames.
    """
    if isinstance(what, LabelledTrajectories):
        return ViewerPage(what, every)
    return page_of_files((Path(what), 0), None if truth is None else (Path(truth), 0), every)


def page_of_files(
    shown: tuple[Path, int], truth: tuple[Path, int] | None, every: int = 1, family: str | None = None
) -> ViewerPage:
    """A page that plays a trajectory of a file, beside the one that it should be.

    Args:
        shown: File and index of the trajectory.
        truth: File and index of what it should be; errors are against it.
        every: Shows every so many frames.
        family: Meaning of type ids if metadata.json lacks it.

    Raises:
        DataError: if a file cannot be read, or the two do not show the same particles.
        ConfigError: if `every` is below 1.
    """
    from nmpm.data.convert import native_file
    from nmpm.data.format import Split
    from nmpm.viz.files import combine, read_labelled

    trajectories = read_labelled(Split(native_file(shown[0])), shown[1], family)
    if truth is not None:
        reference = read_labelled(Split(native_file(truth[0])), truth[1], family)
        trajectories = combine(reference, trajectories, (str(truth[0]), str(shown[0])))
    return ViewerPage(trajectories, every)


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
        self.html = make_page("view", _describe(trajectories, every))

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


def _describe(trajectories: LabelledTrajectories, every: int) -> dict[str, Any]:
    """All that the page's scripts read, as JSON; speeds and errors in domain lengths, per shown frame."""
    positions = {
        label: trajectories.wrap(position[::every].astype(np.float64))
        for label, position in trajectories.positions.items()
    }
    first, *others = positions.values()
    frames, count, dim = first.shape
    room = 2 * frames * count * dim * len(trajectories.further_members)
    stride = min(max(1, -(-room // MEMBER_BYTES)), MOST_LEFT_OUT)
    further = {
        label: trajectories.wrap(each[::every, ::stride].astype(np.float64))
        for label, each in trajectories.further_members.items()
    }
    everything = (np.array(trajectories.outer_bounds).T, trajectories.obstacles, *positions.values(), *further.values())
    points = [each.reshape(-1, dim) for each in everything if each.size]
    low, high = (find.reduce([find.reduce(each, axis=0) for each in points], axis=0) for find in (np.fmin, np.fmax))
    sampled = np.unique(np.linspace(0, frames - 1, SAMPLED_FRAMES).astype(int))
    moved = [path[sampled[1:]] - path[sampled[1:] - 1] for path in positions.values()]
    errors = {label: curve[::every] for label, curve in trajectories.rms_errors().items()}
    index = {name: number for number, name in enumerate(trajectories.materials)}
    spacing = particle_spacing(trajectories.fullest_frame)
    longest = max(high - low for low, high in trajectories.outer_bounds)
    return describe_scene(
        title=trajectories.title or "nmpm",
        bounds=trajectories.bounds,
        domain=trajectories.outer_bounds,
        period=trajectories.periods,
        up=vertical_axis(trajectories),
        dt=trajectories.dt * every,
        spacing=min(spacing, longest / 20),
        materials=trajectories.materials,
        obstacles=trajectories.obstacles,
        low=low,
        high=high,
        frames=frames,
        every=every,
        tilt=trajectories.tilt,
        particles=pack_bytes(np.array([index[name] for name in trajectories.material.tolist()], dtype=np.uint8)),
        fastest=_nearly_largest(trajectories, moved),
        worst=_nearly_largest(trajectories, [other[sampled] - first[sampled] for other in others]),
        trajectories=[
            {
                "label": label,
                "positions": pack_positions(quantize(position, low, high)),
                "errors": [float(f"{error:.6g}") for error in errors.get(label, np.zeros(frames))],
            }
            for label, position in positions.items()
        ],
        members=[
            {"label": label, "positions": pack_positions(_coarse(quantize(position, low, high)))}
            for label, position in further.items()
        ],
        bands={
            "stride": stride,
            "cell": (CELL if stride == 1 else SPARSE_CELL) * min(spacing * stride ** (1 / dim), longest / 20),
            "levels": LEVELS,
            "tints": BAND_TINTS,
            "colour": hex_code(ensemble_colour(trajectories.materials)),
        },
        fields=[_describe_field(trajectories, name, every) for name in trajectories.fields],
        curves=_describe_curves(trajectories, every),
    )


def _coarse(steps: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Positions rounded down to multiples of `MEMBER_STEPS`."""
    return np.where(steps == ABSENT, ABSENT, steps // MEMBER_STEPS * MEMBER_STEPS).astype(np.uint16)


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
