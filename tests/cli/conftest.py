"""Commands run in a folder of their own, with a cache of their own."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """The working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NMPM_HOME", f"{tmp_path}-home")
    return tmp_path
