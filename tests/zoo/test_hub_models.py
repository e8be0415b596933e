"""Models on the hub, tried against a fake of it: pushed, pulled, loaded by id, offline, damaged, private, cut short."""

import huggingface_hub
import pytest
import torch
import yaml
from huggingface_hub import constants
from huggingface_hub.utils import _http

from nmpm.cli import main
from nmpm.errors import ZooError
from nmpm.zoo import Zoo, load_model
from nmpm.zoo.card import FILES
from nmpm.zoo.hub import HubId, download, hub_metadata, pull, push
from tests.zoo.fake_hub import serve


@pytest.fixture
def hub(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with serve() as server:
        monkeypatch.setattr(constants, "ENDPOINT", server.url)
        template = server.url + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub-cache"))
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_PROGRESS_BARS", True)
        monkeypatch.setenv("HF_TOKEN", "hf_token")
        yield server


def test_a_pushed_model_is_loaded_by_its_id_rolled_out_and_pulled(hub, root, tmp_path, capsys):
    assert main(["zoo", "push", "small", "lab/small", "--root", str(root)]) == 0
    identifier = capsys.readouterr().out.split()[1].rstrip(";")
    assert identifier == f"lab/small@{hub.commits['lab/small'][-1][0]}"
    state = Zoo.load("small", root).example(count=50)
    expected = Zoo.load("small", root).rollout(state, 8)
    assert torch.equal(Zoo.load(identifier).rollout(state, 8), expected)
    assert main(["zoo", "pull", identifier, "small/mine"]) == 0
    assert torch.equal(Zoo.load("small/mine").rollout(state, 8), expected)
    assert main(["zoo", "pull", identifier, "small"]) == 0
    for name in ("small", "small/mine"):  # a variant stays where the model of that name comes later
        assert torch.equal(Zoo.load(name).rollout(state, 8), expected)
    for taken in ("small/mine", "goop"):
        assert main(["zoo", "pull", identifier, taken]) == 1
        assert "exists: choose another name" in capsys.readouterr().err


def test_a_cached_revision_loads_offline_and_others_say_why_not(hub, root, small, write_entry, monkeypatch):
    identifier = push(root / "small", "lab/small")
    small.input_std.fill_(3.0)
    push(write_entry(root / "small", small), "lab/small")
    assert (load_model("lab/small@main").emulator.input_std == 3.0).all()
    assert (load_model(str(identifier)).emulator.input_std == 2.0).all()
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    _http.close_session()
    try:
        asked = len(hub.requests)
        load_model(str(identifier))
        assert len(hub.requests) == asked
        with pytest.raises(ZooError, match="not in the cache"):
            load_model("lab/other@main")
        with pytest.raises(ZooError, match="holds no model 'lab/small'"):
            load_model("lab/small")
        assert main(["zoo", "pull", "lab/small"]) == 1
    finally:
        monkeypatch.undo()
        _http.close_session()


def test_private_unknown_and_wrong_models(hub, root, monkeypatch):
    identifier = push(root / "small", "lab/hidden", private=True)
    assert download(identifier).is_dir()
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setattr(huggingface_hub.utils._headers, "get_token", lambda: None)
    for unknown in ("lab/hidden@main", "lab/nothing@main"):
        with pytest.raises(ZooError, match="The hub has no model"):
            load_model(unknown)
    push(root / "small", "lab/small")
    with pytest.raises(ZooError, match="no revision lava"):
        load_model("lab/small@lava")
    oid = hub.commit("lab/small", {"model.safetensors": b"other"})
    with pytest.raises(ZooError, match="SHA-256"):
        pull(HubId("lab/small", oid), root / "pulled", "pulled")
    assert not (root / "pulled").exists()
    hub.commits["lab/empty"] = [("a" * 40, {"README.md": b""})]
    with pytest.raises(ZooError, match="it has no card"):
        load_model("lab/empty@main")


def test_the_hub_is_told_library_licence_and_results(hub, root):
    card = {"name": "goop", "license": "MIT", "dataset": "goop, simulated by nmpm"}
    metadata = hub_metadata(card | {"test": {"mse": 0.1, "still/mse": 1.0}})
    assert (metadata["library_name"], metadata["license"]) == ("nmpm", "mit")
    assert (metadata["datasets"], metadata["metrics"]) == (["goop"], ["mse"])
    result = metadata["model-index"][0]["results"][0]
    assert result["dataset"]["name"] == "goop"
    assert result["metrics"] == [{"type": "mse", "name": "rollout mse", "value": 0.1}]
    push(root / "small", "lab/small")
    readme = hub.commits["lab/small"][-1][1]["README.md"].decode()
    assert yaml.safe_load(readme.split("---")[1])["library_name"] == "nmpm"


def damage(cache, file):
    """Change a byte of a file in the hub's cache."""
    for path in cache.rglob(file):
        content = bytearray(path.resolve().read_bytes())
        content[-1] ^= 1
        path.resolve().write_bytes(content)


@pytest.mark.parametrize("file", ["model.safetensors", pytest.param("card.yaml", marks=pytest.mark.slow)])
def test_a_damaged_file_of_the_cache_is_fetched_again_or_named_with_what_to_delete(hub, root, tmp_path, file):
    identifier = push(root / "small", "lab/small")
    load_model(str(identifier))
    damage(tmp_path / "hub-cache", file)
    hub.cut.add(file)  # a download that ends half-way
    with pytest.raises(ZooError, match=r"SHA-256 differs.*delete .*hub-cache/models--lab--small and load it again"):
        load_model(str(identifier))
    hub.cut.clear()
    assert load_model(str(identifier)).name == "small"
    asked = len(hub.requests)
    load_model(str(identifier))
    assert not [line for line in hub.requests[asked:] if line.startswith("GET") and "resolve" in line]


def test_a_pulled_model_has_its_own_name_and_source_and_can_be_pushed_on(hub, goop, home):
    identifier = push(goop, "lab/goop")
    pushed = hub.commits["lab/goop"][-1][1]["README.md"].decode()
    assert 'Zoo.load("lab/goop@main")' in pushed
    assert main(["zoo", "pull", "lab/goop@main", "goop/theirs"]) == 0
    assert Zoo.load("goop/theirs").name == "goop/theirs"
    assert Zoo.card("goop/theirs")["source"] == str(identifier)
    page = (home / "zoo" / "goop" / "theirs" / "README.md").read_text()
    assert page.startswith("# goop/theirs\n")
    assert 'Zoo.load("goop/theirs")' in page
    assert "(chart.png)" in page
    push(home / "zoo" / "goop" / "theirs", "lab/again")
    again = hub.commits["lab/again"][-1][1]["README.md"].decode()
    assert len([line for line in again.splitlines() if line == "---"]) == 2
    assert 'Zoo.load("lab/again@main")' in again


def test_files_that_an_entry_no_longer_has_are_deleted_on_the_hub(hub, goop):
    push(goop, "lab/goop")
    (goop / "worst.png").unlink()
    push(goop, "lab/goop")
    assert set(hub.commits["lab/goop"][-1][1]) == {".gitattributes", *FILES} - {"worst.png"}
    hub.commit("lab/goop", {"notes.txt": b"mine"})
    push(goop, "lab/goop")
    assert "notes.txt" in hub.commits["lab/goop"][-1][1]


def test_a_private_model_is_not_pushed_to_a_public_repository(hub, root, capsys):
    push(root / "small", "lab/small")
    commits = len(hub.commits["lab/small"])
    assert main(["zoo", "push", "small", "lab/small", "--private", "--root", str(root)]) == 1
    assert "lab/small exists and is public" in capsys.readouterr().err
    assert len(hub.commits["lab/small"]) == commits
    for _ in range(2):
        push(root / "small", "lab/hidden", private=True)
    assert "lab/hidden" in hub.private


def test_commands_of_the_zoo_take_folders_and_ids(hub, goop, capsys):
    identifier = push(goop, "lab/goop")
    for model in (str(goop), str(identifier)):
        assert main(["zoo", "card", model]) == 0
        assert capsys.readouterr().out.startswith("# goop\n")
    assert main(["zoo", "push", str(identifier), "lab/other"]) == 0
    capsys.readouterr()
    assert main(["zoo", "refresh", str(goop), "--failures", "Late splashes become dust."]) == 0
    assert capsys.readouterr().out == f"wrote {goop}\n"
    assert not (goop.parent / "README.md").exists()
    assert Zoo.card("goop", goop.parent)["failures"] == "Late splashes become dust."
    assert main(["zoo", "refresh", str(identifier)]) == 1
    assert f"`nmpm zoo pull {identifier} NAME` makes an entry of it" in capsys.readouterr().err
    assert main(["zoo", "card", str(goop.parent)]) == 1
    assert "`nmpm zoo add RUN NAME` makes an entry of a run" in capsys.readouterr().err
