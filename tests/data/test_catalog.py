from pathlib import Path

import numpy as np
import pytest

from nmpm.data import catalog
from nmpm.data.format import Split, read_metadata
from nmpm.errors import DataError
from nmpm.sim import MpmPreset

COUNTS = {"train": 1, "valid": 1, "test": 1}


@pytest.fixture
def home(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def test_ensure_simulates_once(home):
    folder = catalog.ensure("goop", counts=COUNTS, frames=2)
    assert folder.parent == home / "datasets"
    assert folder.name.startswith("goop-")
    assert read_metadata(folder).sequence_length == 2
    assert Split(folder / "train.h5").frames(0) == 3
    before = (folder / "train.h5").stat().st_mtime_ns
    assert catalog.ensure("goop", counts=COUNTS, frames=2) == folder
    assert (folder / "train.h5").stat().st_mtime_ns == before


@pytest.mark.parametrize("ask", [catalog.ensure, catalog.scene, catalog.describe])
def test_an_unknown_name_lists_the_known_ones(ask):
    with pytest.raises(DataError, match=r"'treacle'.*goop"):
        ask("treacle")


def test_test_trajectories_are_found_whatever_they_were_simulated_for(home):
    assert catalog.find_simulated("goop", 1) is None
    catalog.ensure("goop", counts=COUNTS, frames=2)  # other scenes: shorter
    assert catalog.find_simulated("goop", 1) is None
    folder = catalog.ensure("goop", counts={"train": 0, "valid": 0, "test": 2}, workers=1)
    assert catalog.find_simulated("goop", 1) == catalog.find_simulated("goop", 2) == folder
    assert catalog.find_simulated("goop", 3) is None


def test_more_trajectories_are_copied_where_another_folder_has_them(home, monkeypatch):
    few = catalog.ensure("goop", counts=COUNTS, frames=2)
    catalog.ensure("goop", counts=COUNTS, frames=3)  # other trajectories
    simulated: list[int] = []
    simulate = MpmPreset.simulate
    monkeypatch.setattr(MpmPreset, "simulate", lambda *all_: simulated.append(all_[1]) or simulate(*all_))
    more = catalog.ensure("goop", counts=COUNTS | {"train": 3}, frames=2, workers=1)
    assert len(simulated) == 2
    first = [Split(folder / "train.h5").read(0).position for folder in (few, more)]
    np.testing.assert_array_equal(*first)
    assert len(Split(more / "train.h5")) == 3
