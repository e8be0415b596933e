import numpy as np
import pytest

from nmpm.data import catalog
from nmpm.data.format import Split, read_metadata
from nmpm.errors import DataError
from tests.data.tiny_goop import TINY

COUNTS = {"train": 1, "valid": 1, "test": 1}


def test_ensure_simulates_once_and_copies_what_another_folder_has(home, simulated_seeds):
    folder = catalog.ensure("goop", counts=COUNTS, frames=2, workers=1)
    assert folder.parent == home / "datasets"
    assert folder.name.startswith("goop-")
    assert read_metadata(folder).sequence_length == 2
    assert Split(folder / "train.h5").frames(0) == 3
    before = (folder / "train.h5").stat().st_mtime_ns
    assert catalog.ensure("goop", counts=COUNTS, frames=2) == folder
    assert (folder / "train.h5").stat().st_mtime_ns == before
    catalog.ensure("goop", counts=COUNTS, frames=3, workers=1)  # other trajectories
    simulated_seeds.clear()
    more = catalog.ensure("goop", counts=COUNTS | {"train": 3}, frames=2, workers=1)
    assert len(simulated_seeds) == 2
    assert len(Split(more / "train.h5")) == 3
    np.testing.assert_array_equal(*(Split(path / "train.h5").read(0).position for path in (folder, more)))


@pytest.mark.parametrize("ask", ["ensure", "simulation_request", "describe"])
def test_an_unknown_name_lists_the_known_ones(ask):
    with pytest.raises(DataError, match=r"'treacle'.*goop"):
        getattr(catalog, ask)("treacle")


@pytest.mark.usefixtures("home")
def test_test_trajectories_are_found_whatever_they_were_simulated_for(monkeypatch):
    monkeypatch.setattr(catalog, "load_preset", lambda _: TINY)
    assert catalog.find_simulated("goop", 1) is None
    catalog.ensure("goop", counts=COUNTS, frames=2)  # other scenes: shorter
    assert catalog.find_simulated("goop", 1) is None
    folder = catalog.ensure("goop", counts={"train": 0, "valid": 0, "test": 2}, workers=1)
    assert catalog.find_simulated("goop", 1) == catalog.find_simulated("goop", 2) == folder
    assert catalog.find_simulated("goop", 3) is None
