"""`nmpm view` and `render`: trajectories as a page or as pictures; `nmpm play`: a page on which a model predicts."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.messages import install
from nmpm.cli.command import Command, positional
from nmpm.cli.options import (
    DeviceOptions,
    Existing,
    ModelOptions,
    Natural,
    Positive,
    RuntimeOptions,
    SplitName,
    Style,
    ThreadsOptions,
    TrajectoryFile,
    choose_threads,
    derived_name,
)
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.convert import Options


@dataclass(frozen=True, kw_only=True)
class _Shown(Command):
    """Trajectories that are shown.

    Args:
        file: A rollout, or data of any format that nmpm inspect reads.
        truth: What FILE should be; errors are against it.
        trajectory: Index in FILE, the first by default; of several members, the one that is drawn in full.
        split: Of FILE, if it has several (default: test).
        truth_trajectory: Index in TRUTH (default: that of --trajectory).
        family: Meaning of type ids if metadata.json lacks it: deepmind, lagrangebench.
    """

    file: Existing
    truth: Existing | None = positional()
    trajectory: int = 0
    split: SplitName | None = None
    truth_trajectory: int | None = None
    family: str | None = None

    @property
    def _facts(self) -> Options:
        from nmpm.data.convert import Options

        return Options(family=self.family)

    @property
    def _truth_index(self) -> int:
        return self.trajectory if self.truth_trajectory is None else self.truth_trajectory


@dataclass(frozen=True, kw_only=True)
class View(_Shown):
    """Write a page that plays trajectories in a browser.

    The page is self-contained: it plays a trajectory, or two beside each other. Of a rollout with --members it shows
    all members: faint, as density, or one by one, and bands of height, front, energy.

    Args:
        every: Show every so many frames.
        out: Page to write (default: FILE with the suffix .html).

    Examples:
        nmpm view out.h5                                     a rollout, beside the recording of its --data
        nmpm view out.h5 data/test.h5 --truth-trajectory 3   beside another one with the same start
        nmpm view data/test.h5 --trajectory 7 --every 2      a recorded trajectory, every second frame
        nmpm view tracks.csv --split train                   data of another program

        The page needs no network and no nmpm: send it to anybody. Space plays, ? shows the keys.
    """

    every: Positive = 1
    out: Path | None = None

    def run(self) -> None:
        from nmpm.viz.output import check_output

        out = self.out or derived_name(self.file, ".html")
        check_output(out, (".html",))
        from nmpm.data.convert import native_file
        from nmpm.viz.viewer import page_of_files

        truth = (self.truth, self._truth_index) if self.truth else None
        shown = (native_file(self.file, self.split, self._facts), self.trajectory)
        page_of_files(shown, truth, self.every, self.family).write(out)
        sys.stdout.write(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB): open it in a browser\n")


@dataclass(frozen=True, kw_only=True)
class Render(_Shown):
    """Draw trajectories as PNG and GIF or MP4.

    It draws one trajectory, or two beside each other. Of a rollout with --members it draws one over the share of
    members that are at each place, and bands of height, front and energy.

    Args:
        style: The snapshots, in place of the PNG, for slides (SVG) or for print (PDF).
        mp4: An MP4 in place of the GIF ({install}).
        out: Path of the pictures without suffix (default: that of the file).

    Examples:
        nmpm render out.h5                        a rollout of nmpm rollout: out.png and out.gif
        nmpm render out.h5 truth.h5               beside another trajectory with the same start
        nmpm render out.h5 --mp4 --out splash     splash.png and splash.mp4
        nmpm render out.h5 --style talk           out.svg for slides, with three frames; paper: out.pdf
        nmpm render data/test.h5 --trajectory 7   a recorded trajectory: data/test.png and data/test.gif
    """

    style: Style | None = None
    mp4: bool = False
    out: Path | None = None

    @classmethod
    def help_values(cls) -> Mapping[str, str]:
        return {"install": install("video")}

    def run(self) -> None:
        from nmpm.data.convert import native_file
        from nmpm.data.format import Split
        from nmpm.viz import write_animation, write_snapshots
        from nmpm.viz.files import combine, read_labelled
        from nmpm.viz.output import STYLES, check_output

        stem = self.out or derived_name(self.file, "")
        style = STYLES[self.style] if self.style else None
        suffix, columns = (style.suffix, style.columns) if style else (".png", 6)
        picture = stem.with_name(stem.name + suffix)
        video = stem.with_name(f"{stem.name}{'.mp4' if self.mp4 else '.gif'}")
        split = Split(native_file(self.file, self.split, self._facts))
        if not 0 <= self.trajectory < len(split):
            raise ConfigError(
                f"--trajectory {self.trajectory}: {self.file} contains trajectories 0 … {len(split) - 1}."
            )
        check_output(picture, (suffix,))
        check_output(video, (".gif", ".mp4"))
        trajectories = read_labelled(split, self.trajectory, self.family)
        if self.truth is not None:
            truth = read_labelled(Split(native_file(self.truth)), self._truth_index, self.family)
            trajectories = combine(truth, trajectories, (str(self.truth), str(self.file)))
        for path in (write_snapshots(trajectories, picture, columns), write_animation(trajectories, video)):
            sys.stdout.write(f"wrote {path}\n")


@dataclass(frozen=True, kw_only=True)
class Play(ModelOptions, DeviceOptions, ThreadsOptions, RuntimeOptions):
    """Throw and pour in a browser, while a pretrained model predicts.

    On the page you throw and pour material, drag obstacles, turn gravity.

    Args:
        seed: Of the first scene (default: 0).
        port: Of the server (default: any that is free).
        no_browser: Only print the address.
        out: File that S on the page writes.

    Examples:
        nmpm play                            waterramps: throw water, pour it, drag the ramps
        nmpm play multimaterial              water, sand and goop
        nmpm play variablegravity            turn gravity
        nmpm play runs/mine --seed 3         a run's best, from the scene of a seed

        The page is served to this machine alone, at an address with a token. B runs the simulator beside, S writes what
        was played, ? shows all keys. On a remote machine: ssh -L 8000:127.0.0.1:8000 …, and nmpm play --port 8000
        --no-browser there.
    """

    model: str = positional("waterramps")
    seed: Natural = 0
    port: int = 0
    no_browser: bool = False
    out: TrajectoryFile = Path("played.h5")

    def __post_init__(self) -> None:
        if find_spec("websockets") is None:
            raise ConfigError(f"the page needs a package that is not installed: {install('play')}.")
        super().__post_init__()
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"--port {self.port}: it must be 0 … 65535.")
        if self.out.suffix.lower() != ".h5":
            raise ConfigError(f"--out {self.out}: what was played is written as .h5.")

    def run(self) -> None:
        import asyncio
        import webbrowser

        from nmpm._support.progress import progress_bar
        from nmpm.play.server import PlayServer, play
        from nmpm.play.session import Session
        from nmpm.zoo.registry import load_model

        model = load_model(self.model, self.device, self.root).optimized(self.runtime)
        choose_threads(model, self.threads)
        with progress_bar("the first call", None):
            session = Session(model, self.seed, self.out)

        def announce(address: str) -> None:
            sys.stdout.write(f"{model.name} is played at {address}\nCtrl+C ends it.\n")
            sys.stdout.flush()
            if not self.no_browser:
                webbrowser.open(address)

        try:
            asyncio.run(play(PlayServer(session, self.port), announce))
        except OSError as error:
            raise ConfigError(
                f"--port {self.port}: {error.strerror or error}; leave it out for any free one."
            ) from error
        finally:
            session.close()
