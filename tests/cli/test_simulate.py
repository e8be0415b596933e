import functools
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

from nmpm.cli import main
from nmpm.data.format import Split, read_metadata
from nmpm.data.sources import FolderSource
from nmpm.sim import preset_names
from nmpm.sim.loading import preset_text


def test_lists_every_scene(capsys):
    assert main(["simulate", "--list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in preset_names())
    assert "1000/100/100" in said


def test_makes_a_dataset_to_train_on(tmp_path, capsys):
    words = ["simulate", "waterramps", "--train", "2", "--valid", "1", "--test", "0", "--frames", "3"]
    assert main([*words, "--out", str(tmp_path / "ramps"), "--workers", "1"]) == 0
    assert "wrote 2 train, 1 valid trajectories" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "ramps").glob("*.h5")) == ["train.h5", "valid.h5"]
    origin = FolderSource(tmp_path / "ramps")
    assert origin.scene.obstacles
    assert origin.recordings("train")[0].obstacle.shape[0] > 0
    extra = read_metadata(tmp_path / "ramps").extra
    assert "Simulated by nmpm" in extra["note"]


def test_a_scene_of_ones_own_starts_from_a_copy(tmp_path, capsys):
    assert main(["simulate", "goop", "--show"]) == 0
    text = capsys.readouterr().out
    assert "# m / s²" in text
    (tmp_path / "thick.yaml").write_text(text.replace("name: goop", "name: thick").replace("60.0 ", "90.0 "))
    words = ["simulate", str(tmp_path / "thick.yaml"), "--train", "1", "--valid", "0", "--test", "0", "--frames", "1"]
    assert main([*words, "--out", str(tmp_path / "thick")]) == 0
    assert FolderSource(tmp_path / "thick").scene.materials == ("goop",)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("name: ../../../x", "name = '../../../x'"),
        ("name: ${oc.env:HOME}", "name = '${oc.env:HOME}'"),
        ("name: \udce9", "'utf-8' codec can't decode"),
    ],
    ids=str,
)
def test_a_shared_scene_is_plain_data_whose_name_leads_nowhere(change, said, tmp_path, monkeypatch, capsys):
    (tmp_path / "inner").mkdir()
    monkeypatch.chdir(tmp_path / "inner")
    text = change + "\n" + preset_text("goop").replace("name: goop", "" if change.startswith("name") else "name: x")
    Path("mine.yaml").write_text(text, encoding="utf-8", errors="surrogateescape")
    assert main(["simulate", "mine.yaml", "--train", "1", "--valid", "0", "--test", "0"]) == 1
    complaint = capsys.readouterr().err
    assert said in complaint
    assert complaint.count("\n") == 1
    assert [path.name for path in tmp_path.rglob("*")] == ["inner", "mine.yaml"]


def test_a_preview_is_a_picture_and_nothing_else(tmp_path):
    assert main(["simulate", "sandramps", "--frames", "6", "--preview", "look.png"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["look.png"]
    with Image.open("look.png") as picture:
        assert min(picture.size) > 200


def test_a_preview_may_be_a_file_for_other_programs():
    assert main(["simulate", "sandramps", "--frames", "6", "--preview", "look.vtkhdf"]) == 0
    split = Split(Path("look.vtkhdf"))
    assert (len(split), split.frames(0)) == (1, 7)


def test_an_interruption_says_how_to_go_on(tmp_path):
    """The trajectories that run are stopped: one of them would take minutes."""
    words = ["simulate", "goop", "--train", "2", "--valid", "0", "--test", "0", "--frames", "100000"]
    call = [sys.executable, "-c", "import sys; from nmpm.cli import main; sys.exit(main())", *words]
    # Children of a job in the background, as tests may be, ignore SIGINT otherwise.
    heed = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        [*call, "--out", str(tmp_path / "a")], stderr=subprocess.PIPE, text=True, preexec_fn=heed
    ) as process:
        try:
            while not (tmp_path / "a" / ".parts").is_dir() and process.poll() is None:
                time.sleep(0.1)
            time.sleep(1)
            process.send_signal(signal.SIGINT)
            assert "the same command continues after finished trajectories" in process.communicate(timeout=60)[1]
        finally:
            process.kill()
    assert process.returncode == 130
