"""Which of our models beat the simulator, from the tables that `nmpm trade` wrote.

python benchmarks/beside_simulator.py                   a Markdown table of all of benchmarks/trade/*/trade.csv
python benchmarks/beside_simulator.py trade/mine/trade.csv --measure field

For each model that predicts one scene at a time: the most accurate stable setting of the simulator that is no slower,
and the cheapest stable one that is no less accurate. Nothing is measured here.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from timing import make_parser

TRADE = Path(__file__).parent / "trade"


@dataclass(frozen=True)
class Setting:
    """A timed row of a table.

    Args:
        name: Of the choice.
        milliseconds: Per frame.
        error: Mean over the scenes.
    """

    name: str
    milliseconds: float
    error: float


@dataclass(frozen=True)
class Rivals:
    """A model and the settings of the simulator that it is compared with.

    Args:
        dataset: Of the table.
        particles: Median of the scenes.
        model: The model.
        as_fast: The most accurate setting that is no slower, if there is one.
        as_good: The cheapest setting that is no less accurate; the simulator as shipped, which made the scenes, is one.
    """

    dataset: str
    particles: int
    model: Setting
    as_fast: Setting | None
    as_good: Setting

    @property
    def speed_up(self) -> float:
        """Time of the simulator over the model's, at an error that is no larger."""
        return self.as_good.milliseconds / self.model.milliseconds

    @property
    def gain(self) -> float | None:
        """Error of the simulator over the model's, in no more time; None where no setting is as fast."""
        return None if self.as_fast is None else self.as_fast.error / self.model.error

    @property
    def wins(self) -> bool:
        """Whether no setting is as fast and as accurate."""
        return self.gain is None or self.gain > 1


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a table, one for each choice and measure."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def short_name(row: Mapping[str, str]) -> str:
    """Name of a row's choice in a table whose rows are of the simulator where they are of no model."""
    return row["name"].removeprefix("simulator, ")


def find_rivals(rows: Iterable[Mapping[str, str]], measure: str = "mse") -> list[Rivals]:
    """The models of a table at batch 1, in order of their time; empty where it has no model or no simulator."""
    rows = [row for row in rows if row["error"] == measure and row["stable"] == "True"]
    simulators = [_setting(row) for row in rows if row["kind"] == "simulator" and row["value"]]
    models = [row for row in rows if row["kind"] == "model" and row["batch"] == "1" and row["value"]]
    found = []
    for row in sorted(models, key=lambda row: float(row["ms_per_frame"])):
        model = _setting(row)
        fast = [one for one in simulators if one.milliseconds <= model.milliseconds]
        good = [one for one in simulators if one.error <= model.error]
        if good:
            best = min(fast, key=lambda one: one.error, default=None)
            cheapest = min(good, key=lambda one: one.milliseconds)
            found.append(Rivals(row["dataset"], int(row["particles"]), model, best, cheapest))
    return found


def read_rivals(path: Path, measure: str = "mse") -> list[Rivals]:
    """`find_rivals` in the rows of a table's file."""
    return find_rivals(read_rows(path), measure)


def _setting(row: Mapping[str, str]) -> Setting:
    return Setting(short_name(row), float(row["ms_per_frame"]), float(row["value"]))


def table_lines(rivals: Iterable[Rivals]) -> Iterable[str]:
    """A Markdown table, models that no setting of the simulator beats in bold."""
    yield "| dataset | model | ms | error | simulator, as fast | error | × | simulator, as accurate | ms | × |"
    yield "|---|---|---:|---:|---|---:|---:|---|---:|---:|"
    for one in rivals:
        name = f"**{one.model.name}**" if one.wins else one.model.name
        fast = "none | | " if one.as_fast is None else f"{one.as_fast.name} | {_error(one.as_fast)} | {one.gain:.2g}"
        good = f"{one.as_good.name} | {one.as_good.milliseconds:.3g} | {one.speed_up:.2g}"
        yield f"| {one.dataset} | {name} | {one.model.milliseconds:.3g} | {_error(one.model)} | {fast} | {good} |"


def _error(setting: Setting) -> str:
    return f"{1e3 * setting.error:.3g}"


def main(words: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("tables", nargs="*", type=Path, default=sorted(TRADE.glob("*/trade.csv")), help="trade.csv")
    parser.add_argument("--measure", default="mse", help="the error that counts, a value of the column `error`")
    chosen = parser.parse_args(words)
    rivals = [one for path in chosen.tables for one in read_rivals(path, chosen.measure)]
    sys.stdout.write("\n".join(table_lines(rivals)) + "\n")


if __name__ == "__main__":
    main()
