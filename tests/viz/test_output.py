import errno
import importlib.util
import os
import resource
import sys
import tempfile
from pathlib import Path

import pytest

from nmpm.errors import DataError
from nmpm.viz import write_animation, write_snapshots
from nmpm.viz.frame_renderer import FrameRenderer
from nmpm.viz.output import check_output
from nmpm.viz.panel_renderer import PanelRenderer

needs_ffmpeg = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="imageio-ffmpeg is not installed"
)
FORMATS = [
    pytest.param(write_snapshots, "a.png", id="png"),
    pytest.param(write_animation, "a.gif", id="gif"),
    pytest.param(write_animation, "a.mp4", id="mp4", marks=needs_ffmpeg),
]


@pytest.fixture
def no_drawing(monkeypatch):
    """Makes any drawing fail the test."""

    def fail(*_):
        pytest.fail("drawing started before the output was checked")

    monkeypatch.setattr(FrameRenderer, "__init__", fail)
    monkeypatch.setattr(PanelRenderer, "__init__", fail)


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(("write", "name"), FORMATS)
def test_a_missing_folder_is_reported_before_drawing(falling, tmp_path, write, name):
    with pytest.raises(DataError, match=r"missing does not exist"):
        write(falling, tmp_path / "missing" / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(("write", "name"), FORMATS)
def test_a_read_only_folder_is_reported_before_drawing(falling, tmp_path, monkeypatch, write, name):
    def fail(**_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(tempfile, "TemporaryFile", fail)  # permission bits do not stop root
    with pytest.raises(DataError, match=r"not writable \(Read-only file system\)"):
        write(falling, tmp_path / name)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="there is no /proc")
def test_the_check_finds_a_folder_in_which_nothing_can_be_created():
    with pytest.raises(DataError, match="not writable"):
        check_output(Path("/proc/self/a.png"))


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(("write", "name"), FORMATS)
def test_a_folder_in_place_of_the_file_is_reported_before_drawing(falling, tmp_path, write, name):
    (tmp_path / name).mkdir()
    with pytest.raises(DataError, match="is a folder"):
        write(falling, tmp_path / name)


@pytest.mark.parametrize(("write", "name"), FORMATS)
def test_an_exception_while_drawing_keeps_the_old_file(falling, tmp_path, monkeypatch, write, name):
    (tmp_path / name).write_text("old")
    draw, calls = PanelRenderer.draw, iter(range(1000))

    def draw_some(self, position):
        if next(calls) == 15:
            raise KeyboardInterrupt
        return draw(self, position)

    monkeypatch.setattr(PanelRenderer, "draw", draw_some)
    columns = {"columns": 11} if write is write_snapshots else {}
    with pytest.raises(KeyboardInterrupt):
        write(falling, tmp_path / name, **columns)
    assert (tmp_path / name).read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(("write", "name"), FORMATS)
def test_a_full_disk_keeps_the_old_file(falling, tmp_path, write, name):
    """A limit on the file size stands for the full disk; it also holds for the encoder's process."""
    (tmp_path / name).write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with pytest.raises(DataError, match=rf"Cannot write \S*{name}: [^\n]*$"):
            write(falling, tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / name).read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == [name]


@needs_ffmpeg
def test_a_failing_encoder_is_reported(falling, tmp_path, monkeypatch):
    """The encoder reads everything, then fails without closing the video: imageio does not report it."""
    encoder = tmp_path / "encoder.py"
    lines = "import sys", "open(sys.argv[-1], 'wb').write(b'half')", "sys.stdin.buffer.read()", "sys.exit(1)"
    encoder.write_text("\n".join((f"#!{sys.executable}", *lines)))
    encoder.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(encoder))
    monkeypatch.chdir(tmp_path)  # counting frames, it is told to write to "-"
    with pytest.raises(DataError, match="video encoder"):
        write_animation(falling, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()
