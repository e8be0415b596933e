"""`nmpm play [MODEL]`: throw and pour in a browser, while the emulator runs."""

from __future__ import annotations

import argparse
import sys
from importlib.util import find_spec
from pathlib import Path

from nmpm._support.messages import install
from nmpm.cli.options import (
    CommandParser,
    add_device_option,
    add_model_options,
    add_runtime_option,
    add_threads_option,
    check_at_least,
    check_device,
    check_model,
    check_runtime,
    choose_threads,
)
from nmpm.data.write import find_writer
from nmpm.errors import ConfigError

DEFAULT = "waterramps"

_EXAMPLES = """\
examples:
  nmpm play                            waterramps: throw water, pour it, drag the ramps
  nmpm play multimaterial              water, sand and goop
  nmpm play variablegravity            turn gravity
  nmpm play runs/mine --seed 3         a run's best, from the scene of a seed

The page is served to this machine alone, at an address with a token. B runs the simulator beside,
S writes what was played, ? shows all keys. On a remote machine: ssh -L 8000:127.0.0.1:8000 …, and
nmpm play --port 8000 --no-browser there.
"""


def run(words: list[str]) -> None:
    """Run the command, e.g. ["play", "goop"]."""
    options = _parser().parse_args(words[1:])
    _check(options)
    import asyncio
    import webbrowser

    from nmpm._support.progress import progress_bar
    from nmpm.play.server import PlayServer, play
    from nmpm.play.session import Session
    from nmpm.zoo.registry import load_model

    model = load_model(options.model, options.device, options.root).optimized(options.runtime)
    choose_threads(model, options.threads)
    with progress_bar("the first call", None):
        session = Session(model, options.seed, options.out)

    def announce(address: str) -> None:
        sys.stdout.write(f"{model.name} is played at {address}\nCtrl+C ends it.\n")
        sys.stdout.flush()
        if not options.no_browser:
            webbrowser.open(address)

    try:
        asyncio.run(play(PlayServer(session, options.port), announce))
    except OSError as error:
        raise ConfigError(
            f"--port {options.port}: {error.strerror or error}; leave it out for any free one."
        ) from error
    finally:
        session.close()


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="nmpm play",
        description="Play with a trained model in a browser: throw and pour material, drag obstacles, turn gravity.",
        epilog=_EXAMPLES,
    )
    add_model_options(parser, default=DEFAULT)
    add_device_option(parser)
    add_threads_option(parser)
    add_runtime_option(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the first scene (default: 0)")
    parser.add_argument("--port", type=int, default=0, help="of the server (default: any that is free)")
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    parser.add_argument(
        "--out", type=Path, default=Path("played.h5"), help="file that S on the page writes (default: played.h5)"
    )
    return parser


def _check(options: argparse.Namespace) -> None:
    """Check what needs no torch."""
    if find_spec("websockets") is None:
        raise ConfigError(f"the page needs a package that is not installed: {install('play')}.")
    check_at_least("--seed", options.seed, 0)
    check_at_least("--threads", options.threads, 1)
    if not 0 <= options.port <= 65535:
        raise ConfigError(f"--port {options.port}: it must be 0 … 65535.")
    if options.out.suffix.lower() != ".h5":
        raise ConfigError(f"--out {options.out}: what was played is written as .h5.")
    find_writer("--out", options.out)
    check_model(options.model, options.root)
    check_device(options.device)
    check_runtime(options.runtime)
