"""`nmpm inspect PATH`."""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm.cli.command import option
from nmpm.cli.options import Existing, FactOptions, Picture, Positive
from nmpm.errors import ConfigError, DataError, NmpmError

if TYPE_CHECKING:
    from nmpm.data.sources import FolderSource


@dataclass(frozen=True, kw_only=True)
class Inspect(FactOptions):
    """Summarise a dataset on one screen, with anything odd about it.

    What contradicts itself comes first; the first trajectory is drawn.

    Args:
        path: A dataset, of any format that nmpm convert reads.
        format: Format of the dataset (default: detected).
        json: Print everything as JSON, draw nothing.
        trajectories: Read N of each split (default: 256 MiB of it).
        out: Picture to write (default: inspect-NAME.png).
        no_picture: Do not draw.

    Examples:
        nmpm inspect ramps                                   a dataset in the native layout
        nmpm inspect datasets/WaterRamps                     any format that nmpm convert reads
        nmpm inspect waterdrop --family deepmind --gravity 0,-9.81
        nmpm inspect ramps --json | jq .grids
    """

    path: Existing
    format: str | None = option(metavar="NAME")
    json: bool = False
    trajectories: Positive | None = option(metavar="N")
    out: Picture | None = None
    no_picture: bool = False

    def run(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            native = Path(folder) / (self.path.resolve().stem or "dataset")
            self._inspect(*self._open(native))

    def _open(self, native: Path) -> tuple[FolderSource, list[str]]:
        """The dataset, and problems of its conversion, which is in `native` if the dataset is damaged."""
        from nmpm.data.convert import convert, native_folder
        from nmpm.data.format import is_native, split_paths
        from nmpm.data.sources import FolderSource

        beside = split_paths(self.path.parent).values()
        path, problems = self.path.parent if self.path in beside else self.path, list[str]()
        if self.format is None:
            if is_native(path):
                return FolderSource(path, self.facts), []
            try:
                return FolderSource(native_folder(path, self.facts)), []  # the copy has the facts
            except ConfigError as error:  # the gravity contradicts the files
                return FolderSource(native_folder(path, replace(self.facts, gravity=None))), [str(error)]
            except DataError as error:
                problems = [str(error)]
        damage: list[str] = []
        convert(path, native, self.format, self.facts, problems=damage)
        return FolderSource(native), damage or problems

    def _inspect(self, source: FolderSource, damage: list[str]) -> None:
        from nmpm.data.findings import Finding, Severity
        from nmpm.data.inspection import inspect, open_dataset
        from nmpm.data.inspection_text import describe
        from nmpm.evaluation.pace import measure_machine

        inspection = inspect(source, self.trajectories, measure_machine)
        damaged = (Finding("unreadable", Severity.CONTRADICTION, problem) for problem in damage)
        inspection = replace(inspection, path=str(self.path), findings=(*damaged, *inspection.findings))
        if self.json:
            sys.stdout.write(json.dumps(asdict(inspection), indent=1) + "\n")
            return
        sys.stdout.writelines(f"{line}\n" for line in describe(inspection))
        if self.no_picture:
            return
        from nmpm.viz import write_snapshots
        from nmpm.viz.files import label_trajectory

        path, title = self.path.resolve(), f"{self.path.name}, first trajectory"
        try:
            data = open_dataset(source)
            trajectory = next(iter(data.splits.values())).read(0)
            pictured = label_trajectory(trajectory, "recorded", data.source.metadata, data.source.scene, title)
            out = write_snapshots(pictured, self.out or Path(f"inspect-{path.stem}.png"))
            sys.stdout.write(f"\nwrote {out}\n")
        except (NmpmError, OSError) as error:
            sys.stdout.write(f"\nno picture: {error}\n")
