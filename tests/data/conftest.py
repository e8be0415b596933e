"""What tests of datasets share: a home, and tiny simulations."""

from pathlib import Path

import pytest

from nmpm.sim import MpmPreset


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty NMPM_HOME."""
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def simulated_seeds(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seeds of all that is simulated in this process."""
    seeds: list[int] = []
    simulate = MpmPreset.simulate
    monkeypatch.setattr(MpmPreset, "simulate", lambda preset, seed, *_: seeds.append(seed) or simulate(preset, seed))
    return seeds
