import pytest
import yaml

from nmpm._support.shipped import shipped_folder, user_home
from nmpm.cli import main
from nmpm.zoo import Zoo


@pytest.fixture
def home():
    return user_home()


def copy(name, folder):
    folder.mkdir(parents=True)
    for path in (shipped_folder("zoo") / name).glob("*.*"):
        (folder / path.name).write_bytes(path.read_bytes())


def test_own_models_are_marked_in_the_list(home, capsys):
    copy("goop", home / "zoo" / "goop" / "mine")
    assert main(["zoo", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == Zoo.list()
    assert [line.split()[1] for line in lines if "yours" in line] == ["yours"]
    assert next(line for line in lines if "yours" in line).startswith("goop/mine")


def test_another_zoo_before_or_after_the_command(tmp_path, capsys):
    copy("goop", tmp_path / "other" / "goop")
    for words in (["--root", "other", "list"], ["list", "--root", "other"]):
        assert main(["zoo", *words]) == 0
        assert capsys.readouterr().out.count("\n") == 1
    assert main(["zoo", "card", "goop", "--root", "other", "--yaml"]) == 0
    assert "sha256" in capsys.readouterr().out


def test_a_card_is_a_page_to_read_or_yaml_for_programs(home, capsys):
    assert main(["zoo", "card", "goop"]) == 0
    page = capsys.readouterr().out
    assert page.startswith("# goop\n")
    assert "| nothing moves |" in page
    assert len(page.splitlines()) < 75  # two screens
    assert main(["zoo", "card", "goop", "--yaml"]) == 0
    assert yaml.safe_load(capsys.readouterr().out) == Zoo.card("goop")
    (home / "zoo" / "bare").mkdir(parents=True)
    (home / "zoo" / "bare" / "card.yaml").write_text("format: 1\nname: bare\n")
    assert main(["zoo", "card", "bare"]) != 0
    assert "`nmpm zoo card bare --yaml` shows what it has" in capsys.readouterr().err


def test_a_damaged_card_does_not_hide_the_others(home, capsys):
    copy("goop", home / "zoo" / "broken")
    (home / "zoo" / "broken" / "card.yaml").write_text("{")
    copy("goop", home / "zoo" / "bare")
    (home / "zoo" / "bare" / "card.yaml").write_text("format: 1\nname: bare\n")
    assert main(["zoo", "list"]) == 0
    said = capsys.readouterr().out
    assert "cannot be read" in said
    assert "full-rollout MSE not measured   data not stated" in said
    assert "goop, simulated by nmpm" in said


def test_all_are_verified_though_one_is_damaged(tmp_path, capsys):
    copy("goop", tmp_path / "other" / "a")
    (tmp_path / "other" / "a" / "model.safetensors").write_bytes(b"")
    copy("goop", tmp_path / "other" / "b")
    (tmp_path / "other" / "b" / "card.yaml").write_text("{")
    copy("goop", tmp_path / "other" / "goop")
    assert main(["zoo", "verify", "--root", "other"]) == 1
    said = capsys.readouterr().out
    assert said.count("FAIL  other/") == 2
    assert "pass  test scene 0" in said
    assert "2 figures are not confirmed" in said
    assert main(["zoo", "verify", "a", "--root", "other"]) == 1
    assert "SHA-256 differs" in capsys.readouterr().err
