import json
from importlib.util import find_spec

import pytest

from nmpm.cli import main
from nmpm.evaluation.stress.results import TestResult


def test_one_group_of_a_zoo_model_as_json(capsys, tmp_path):
    assert main(["stress", "goop", "--groups", "poison", "--json", "--report", str(tmp_path)]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["model"] == "goop"
    assert [line["passed"] for line in plain["lines"]] == [True] * 5
    assert json.loads((tmp_path / "stress.json").read_text()) == plain


def test_scenes_of_another_simulator_are_matched(capsys):
    assert main(["stress", "goop", "--preset", "sandramps", "--groups", "poison", "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["lines"]
    assert "goop takes these data as follows." in said.err
    assert "sand -> goop" in said.err
    assert main(["stress", "goop", "--preset", "goop", "--groups", "poison"]) == 0
    assert "as follows" not in capsys.readouterr().out


def test_a_table_for_people(capsys):
    assert main(["stress", "waterdrop", "--groups", "poison"]) == 0
    out = capsys.readouterr().out
    assert "a weight that is not finite" in out
    assert "5 passed, 0 failed." in out


@pytest.mark.slow
def test_by_another_runtime(capsys):
    if find_spec("openvino") is None:  # importing it would report to its makers
        pytest.skip("openvino is not installed")
    assert main(["stress", "goop", "--runtime", "openvino", "--groups", "poison"]) == 0
    assert "5 passed, 0 failed." in capsys.readouterr().out


def test_a_failing_line_is_an_exit_status(monkeypatch, capsys):
    failed = [TestResult("long", "one", False, {}, "nothing")]
    monkeypatch.setattr("nmpm.evaluation.stress.model.battery", lambda *_: failed)
    assert main(["stress", "goop", "--groups", "long"]) == 1
    assert "0 passed, 1 failed: one." in capsys.readouterr().out
