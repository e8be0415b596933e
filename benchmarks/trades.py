"""Measure all charts of the trade with one command: on all test scenes, beside a graph network, and the map.

python benchmarks/trades.py --out runs/trades
python benchmarks/trades.py --out runs/trades --dry-run        print the commands, with their estimated CPU time
python benchmarks/trades.py --steps dambreak2d waterdrop-xl

Each step writes its output to OUT/STEP.log. Run the same command again to continue: steps that have succeeded are
skipped, and `nmpm trade` and the training measure only what is missing. OUT/NAME then has the trade.csv, trade.png and
trade.md of `benchmarks/trade/NAME`; stored points in OUT/NAME/points of an earlier run are used. Errors do not depend
on other load, times do: leave the machine alone.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gpu import run_steps
from timing import make_parser

MINUTES = ("1", "2", "4", "7", "10", "20")
"""Training times after which the graph network is written."""
ROLLED_OUT = ("10", "20")
"""Those that are rolled out; each takes ten minutes on 20 scenes."""
MODELS: Mapping[str, Sequence[str]] = {
    "goop": ("goop", "goop/fast"),
    "waterramps": ("waterramps", "waterramps/fast", "waterdrop", "waterdrop-xl"),
    "dambreak2d": ("dambreak2d",),
    "waterdrop-xl": ("waterdrop-xl", "waterramps", "waterdrop"),
}
"""Charts, and the zoo's models that can take their scenes."""


@dataclass(frozen=True)
class Step:
    """A command.

    Args:
        words: Of it.
        minutes: CPU time on one core of an AMD EPYC (avx512), estimated from times per frame.
    """

    words: tuple[str, ...]
    minutes: int


def list_steps(out: Path) -> dict[str, Step]:
    """The steps in order, by name."""
    graph = ("benchmarks/gns.py", "goop", "--minutes", *MINUTES, "--out", str(out / "gns"))
    graphs = tuple(f"gns:load:{out / 'gns' / f'minutes-{minutes}.pt'}" for minutes in ROLLED_OUT)
    return {
        "gns": Step((sys.executable, *graph), 22),
        "goop": _trade("goop", out, 25, graphs),
        "waterramps": _trade("waterramps", out, 10),
        "dambreak2d": _trade("dambreak2d", out, 28),
        "waterdrop-xl": _trade("waterdrop-xl", out, 15),
        "map": Step((sys.executable, "benchmarks/where_emulation_pays.py", "--out", str(out)), 12),
    }


def _trade(name: str, out: Path, minutes: int, predictors: tuple[str, ...] = ()) -> Step:
    words = ("trade", name, "--config", f"benchmarks/trade/{name}.yaml", "--models", *MODELS[name])
    words += ("--predictors", *predictors) if predictors else ()
    return Step((sys.executable, "-m", "nmpm", *words, "--out", str(out / name)), minutes)


def main() -> None:
    """Run or print the steps."""
    parser = make_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/trades"), help="folder (default: runs/trades)")
    parser.add_argument("--steps", nargs="+", choices=list(list_steps(Path())), help="only these")
    parser.add_argument("--dry-run", action="store_true", help="print the commands and run nothing")
    chosen = parser.parse_args()
    steps = list_steps(chosen.out.resolve())
    steps = {name: steps[name] for name in chosen.steps or steps}
    if chosen.dry_run:
        for name, step in steps.items():
            sys.stdout.write(f"{name}, about {step.minutes} min: {shlex.join(step.words)}\n")
        return
    folders = (str(Path(__file__).parent), os.environ.get("PYTHONPATH", ""))  # `nmpm trade` imports gns.py
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, folders))
    failed = run_steps({name: list(step.words) for name, step in steps.items()}, chosen.out.resolve())
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
