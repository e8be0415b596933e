import io

import pytest
from rich.console import Console

from nmpm._support import progress
from nmpm._support.progress import progress_bar


@pytest.fixture
def output(monkeypatch):
    """Stands in for standard error, of a kind; time passes only where a test says so."""

    def make(**kind) -> io.StringIO:
        file = io.StringIO()
        monkeypatch.setattr(progress, "Console", lambda **_: Console(file=file, width=100, **kind))
        return file

    return make


def test_a_terminal_shows_a_bar(output):
    file = output(force_terminal=True)
    with progress_bar("work", 2) as step:
        step("half of it")
    assert "half of it" in file.getvalue()
    assert "1/2" in file.getvalue()
    assert "ETA" in file.getvalue()


def test_a_bar_within_a_bar_is_another_line_of_it(output):
    file = output(force_terminal=True)
    with progress_bar("all", 2) as step, progress_bar("part", 7) as inner:
        inner()
        step()
    assert "0/7" in file.getvalue()
    assert file.getvalue().count("\x1b[?25l") == 1  # hides the cursor: one display


@pytest.mark.parametrize("kind", [{"force_terminal": False}, {"force_jupyter": True}], ids=["a file", "no widgets"])
def test_elsewhere_long_work_prints_a_line_now_and_then(output, monkeypatch, recwarn, kind):
    monkeypatch.setattr(progress, "find_spec", lambda name: None)
    now = iter([0, 20, 40, 50, 65, 80, 80])  # at the start, after each step, at the end
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    file = output(**kind)
    with progress_bar("work", 9, done=4) as step:
        for what in ("", "", "more work", "", ""):
            step(what)
    lines = file.getvalue().splitlines()
    if "force_terminal" in kind:
        assert lines == ["work: 6 of 9 (67%), 0:01:00 left", "more work: 9 of 9, 0:01:20 in all"]
    assert not recwarn.list
