"""How much a newcomer has to hold in mind. A change that needs more raises the budget here, and its commit says why."""

import runpy
from pathlib import Path

import pytest

HOUSE = Path(__file__).parent.parent / "benchmarks" / "house.py"
if not HOUSE.is_file():
    pytest.skip("benchmarks are not part of this distribution", allow_module_level=True)
house = runpy.run_path(str(HOUSE))

ROOMS = {
    "_support": (1700, 13),
    "cli": (4200, 21),
    "data": (15650, 64),
    "emulator": (8400, 51),
    "evaluation": (4050, 27),
    "metrics": (700, 5),
    "play": (1400, 10),
    "processors": (1400, 9),
    "sim": (3850, 15),
    "training": (3200, 20),
    "viz": (2050, 12),
    "zoo": (4650, 28),
}
"""Lines and files of each room."""
CIRCLES = {"emulator": 29}
"""Files of the largest circle of imports in a room; none in the others."""
IMPORTS = 8.0
"""Per cent of the lines that only import."""
CALLS = {"first Zoo.load": (85, 270), "rollout of one bundle": (36, 175), "opening a foreign .npz": (33, 295)}
"""Files and functions of the package that a call enters."""


@pytest.fixture(scope="module")
def counted():
    return house["count"]()


def test_rooms_are_within_their_budgets(counted):
    over = {room: size for room, size in counted["by room"].items() if any(map(int.__gt__, size, ROOMS[room]))}
    assert not over


def test_a_class_has_a_name_of_its_own(counted):
    assert not counted["class names that stand twice"]


def test_circles_of_imports_do_not_grow(counted):
    assert {room: size for room, size in counted["largest circles"].items() if size > CIRCLES.get(room, 1)} == {}


def test_few_lines_only_import(counted):
    assert counted["imports %"] <= IMPORTS


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_a_call_enters_few_files(call):
    entered = house["trace"](house["TRACES"][call])["files, functions"]
    assert all(map(int.__le__, entered, CALLS[call])), entered
