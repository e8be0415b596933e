"""`nmpm convert SOURCE DESTINATION`, both ways."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nmpm.cli.command import option
from nmpm.cli.options import FactOptions, Natural, SplitName, check_folder
from nmpm.data.stated import Text
from nmpm.errors import ConfigError


def _new_ids(text: str) -> dict[int, int]:
    pairs = [pair.split("=") for pair in text.split(",")]
    return {int(old): int(new) for old, new in pairs}


_NEW_IDS = Text(_new_ids, "OLD=NEW pairs of type ids, e.g. 5=0,3=1")


@dataclass(frozen=True, kw_only=True)
class Convert(FactOptions):
    """Convert a dataset of another format to the native layout.

    The native layout is LagrangeBench's: HDF5 files with a metadata.json. Trajectories can also be written to files for
    other programs: a DESTINATION that ends in {suffixes} is a file for one trajectory; of several, each becomes a file
    in a folder of that name. Any other is a folder for a dataset in the native layout.

    The format of the source is detected, or named by --format:
    {formats}

    Type ids keep their numbers. What they mean differs between families of datasets: 3 is a boundary for deepmind, a
    rigid body for lagrangebench, a heated wall for jax-sph. The command prints which family it assumed.

    Args:
        source: File or folder to read.
        destination: Folder to write, new or empty; or a file, by its suffix: {suffixes}.
        format: Format of the source (default: detected).
        ids: New type ids in the written files, e.g. 5=0,3=1.
        trajectory: Write this one to a file (default: all).
        split: Of the trajectories (default: all; of one: test).

    Examples:
        nmpm convert datasets/WaterRamps water                 DeepMind's TFRecords
        nmpm convert flume/test.npz flume --types 1=debris --bounds 0.02:1,0:0.2
        nmpm convert heated-channel channel --family jax-sph --boundary periodic,wall
        nmpm convert out.h5 out.vtkhdf                         a rollout for ParaView; .usda: Blender
        nmpm convert water splash.csv --trajectory 3           one trajectory of a dataset, of its tests
        nmpm convert ramps ramps-for-lagrangebench --ids 5=0,3=1   LagrangeBench: 0 fluid, 1 wall
    """

    source: Path
    destination: Path
    format: str | None = option(metavar="NAME")
    ids: Mapping[int, int] | None = option(metavar="OLD=NEW,...", text=_NEW_IDS)
    trajectory: Natural | None = option(metavar="N")
    split: SplitName | None = None

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        from nmpm.data.convert import summaries
        from nmpm.data.write import suffixes

        lines = summaries()
        width = max(map(len, lines))
        formats = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in lines.items())
        return {"formats": formats, "suffixes": suffixes()}

    def run(self) -> None:
        if _is_file_name(self.destination):
            self._export()
            return
        if self.trajectory is not None or self.split is not None:
            raise ConfigError("--trajectory and --split are for a DESTINATION that is a file.")
        from nmpm.data.convert import convert

        check_folder("DESTINATION", self.destination)
        for note in convert(self.source, self.destination, self.format, self.facts, self.ids):
            sys.stdout.write(f"- {note}\n")
        look = f"nmpm inspect {shlex.quote(str(self.destination))}"
        sys.stdout.write(f"wrote {self.destination}; to look at it: {look}\n")

    def _export(self) -> None:
        from nmpm.data.convert import open_complete
        from nmpm.data.convert.conversion import export, renumber_types
        from nmpm.data.write import find_writer

        writer, source = find_writer("DESTINATION", self.destination), self.source.resolve()
        if source in (self.destination.resolve(), self.destination.with_suffix("").resolve()):
            raise ConfigError(f"DESTINATION {self.destination}: it would replace the source; choose another name.")
        with open_complete(self.source, self.format, self.facts) as opened:
            dataset = renumber_types(opened, self.ids) if self.ids else opened
            exported = export(dataset, self.destination, self.split, self.trajectory)
        for note in (*dataset.notes, *exported.notes):
            sys.stdout.write(f"- {note}\n")
        if exported.files == 1:
            sys.stdout.write(f"wrote {exported.path}; to look at it: {writer.hint(exported.path)}\n")
        else:
            sys.stdout.write(f"wrote {exported.files} trajectories to {exported.path}, a file each\n")


def _is_file_name(destination: Path) -> bool:
    """Whether a name is that of a file; raises ConfigError if it looks like one of a form that is not written."""
    from nmpm.data.write import is_written_by_suffix, suffixes

    if destination.is_dir() or not re.fullmatch(r"\.[a-zA-Z]\w{1,9}", destination.suffix):
        return False
    if not is_written_by_suffix(destination):
        raise ConfigError(
            f"DESTINATION {destination}: nothing is written by that suffix; there are {suffixes()}. For a folder of"
            " that name, create it first."
        )
    return True
