"""A viewer for browsers: one self-contained HTML page that plays trajectories, drawn by WebGL.

`view` is what notebooks call; `nmpm view` writes the page to a file.
"""

from __future__ import annotations

from pathlib import Path

from nmpm.viz.trajectories import LabelledTrajectories
from nmpm.viz.viewer.page import ViewerPage

__all__ = ["ViewerPage", "page_of_files", "view"]


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
