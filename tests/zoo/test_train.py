"""`zoo/train.py` trains in stages, goes on where it was interrupted, and makes the entry."""

import importlib.util
import json
from pathlib import Path

import pytest
import yaml

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def script():
    spec = importlib.util.spec_from_file_location("train_zoo", REPOSITORY / "zoo" / "train.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_stages_follow_one_another_and_an_interrupted_one_goes_on(script, tmp_path, monkeypatch):
    queue = [{"name": "dust", "config": "goop.yaml", "stages": [{"hours": 2}, {"hours": 1, "options": {"seed": 3}}]}]
    (tmp_path / "queue.yaml").write_text(yaml.safe_dump(queue))
    called, interrupted = [], ["2"]

    def nmpm(words):
        called.append(words)
        if words[0] == "fit":
            run = Path(words[2] if words[1] == "--resume" else words[words.index("--trainer.default_root_dir") + 1])
            (run / "checkpoints").mkdir(parents=True, exist_ok=True)
            (run / "checkpoints" / "last.ckpt").touch()
            if run.name in interrupted:
                return interrupted.remove(run.name) or 130
            report = {"training": {"seconds": 10.0, "steps": 5}, "curve": [[6.0, 3, 0.5]]}
            (run / "report.json").write_text(json.dumps(report))
        return 0

    monkeypatch.setattr("nmpm.cli.main", nmpm)
    words = ["--queue", str(tmp_path / "queue.yaml"), "--runs", str(tmp_path / "runs"), "--device", "cuda:1"]
    second = str(tmp_path / "runs" / "dust" / "2")
    assert script.main(words) == 130
    assert [call[0] for call in called] == ["fit", "fit"]
    first, following = (dict(zip(call[1::2], call[2::2], strict=True)) for call in called)
    assert (first["--trainer.max_time"], first["--trainer.devices"]) == ("00:02:00:00", "[1]")
    assert following["--start_from"] == str(tmp_path / "runs" / "dust" / "1" / "checkpoints" / "best.ckpt")
    assert (following["--seed"], following["--trainer.val_check_interval"]) == ("3", "00:00:02:00")
    called.clear()
    assert script.main(words) == 0
    assert called[0][:3] == ["fit", "--resume", second]
    assert [call[:2] for call in called[1:]] == [["test", second], ["zoo", "add"], ["zoo", "refresh"]]
    report = json.loads((Path(second) / "report.json").read_text())
    assert report["training"] == {"seconds": 20.0, "steps": 10}
    assert report["curve"] == [[6.0, 3, 0.5], [16.0, 8, 0.5]]


def test_the_queue_names_models_once_and_configurations_that_exist(script, capsys, tmp_path):
    queue = yaml.safe_load((REPOSITORY / "zoo" / "queue.yaml").read_text())
    names = [model["name"] for model in queue]
    assert sorted(names) == sorted(
        path.parent.relative_to(REPOSITORY / "zoo").as_posix() for path in (REPOSITORY / "zoo").rglob("card.yaml")
    )
    assert all((REPOSITORY / "configs" / model["config"]).is_file() for model in queue)
    assert script.main(["--dry-run", "--runs", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("nmpm fit") == 29
