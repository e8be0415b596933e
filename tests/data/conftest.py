"""What most tests of datasets share."""

from pathlib import Path

import pytest


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty NMPM_HOME."""
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"
