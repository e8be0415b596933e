"""The training of the zoo: rounds, extensions, interruptions by kill -9, locks, and the entries that come of it."""

import csv
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from nmpm._support.plain_data import from_plain
from nmpm.cli import main
from nmpm.errors import ConfigError
from nmpm.metrics import MSE
from nmpm.zoo import Zoo
from nmpm.zoo.queue.collection import describe_data, is_collected, simulator_facts
from nmpm.zoo.queue.history import History
from nmpm.zoo.queue.plan import Dataset, Extension, Plan, continued_training, new_training
from nmpm.zoo.queue.training import Training
from nmpm.zoo.queue.validations import lowest_errors
from nmpm.zoo.scenes import iterate_test_scenes

SCRIPT = Path(__file__).parents[2] / "zoo" / "train.py"
if not SCRIPT.is_file():
    pytest.skip("the script is not part of this distribution", allow_module_level=True)
TINY = {
    "model.unroll": 1, "model.cells": 16, "model.processor.width": 4, "model.processor.depth": 1, "model.mirror": [],
    "data.batch_size": 2, "trainer.precision": "32-true", "trainer.enable_progress_bar": False,
    "trainer.log_every_n_steps": 1, "resume.every_n_train_steps": 5, "model.schedule.warmup": 1,
}  # fmt: skip


@pytest.fixture
def queue(make_dataset, tmp_path, monkeypatch):
    """Writes a queue of one dataset in the working directory; `hours` of its first training."""
    monkeypatch.chdir(tmp_path)
    sizes = ((40, 9),) * 2
    data = str(make_dataset(train=sizes, valid=sizes, test=sizes))

    def write(hours: float, /, **extension: float) -> Path:
        entry = {"name": "small", "config": "waterdrop.yaml", "hours": hours, "options": TINY | {"data.path": data}}
        path = tmp_path / "queue.yaml"
        path.write_text(yaml.safe_dump({"extension": extension or {"hours": 0}, "datasets": [entry]}))
        return path

    return write


def words(queue: Path, *more: str) -> list[str]:
    return ["--queue", str(queue), "--runs", "runs", "--zoo", "zoo", "--device", "cpu", *more]


def train(queue: Path, *more: str) -> int:
    return runpy.run_path(str(SCRIPT))["main"](words(queue, *more))


def finished(folder: Path, *errors: float) -> None:
    """What trainings of half an hour each leave, with these validation errors."""
    for number, error in enumerate(errors, 1):
        run = folder / str(number)
        (run / "checkpoints").mkdir(parents=True)
        (run / "checkpoints" / "best.ckpt").touch()
        (run / "words.json").write_text("[]")
        report = {"training": {"seconds": 1800.0, "steps": 10}, "curve": [[900.0, 5, 2 * error], [1800.0, 10, error]]}
        (run / "report.json").write_text(json.dumps(report))


@pytest.mark.parametrize(
    ("errors", "following"),
    [([], 1), ([0.5], 2), ([0.5, 0.48], 3), ([0.5, 0.49], None), ([0.5, 0.6], None), ([0.5, 0.4, 0.2, 0.1], None)],
    ids=str,
)
def test_a_dataset_is_extended_until_that_gains_too_little_or_its_hours_are_over(tmp_path, errors, following):
    finished(tmp_path, *errors)
    extension = Extension(hours=0.5, gain=0.03, limit=2.0)
    history = History(Dataset("small", "goop.yaml", 0.5), tmp_path, extension)
    assert history.next_round() == following
    least, most = history.hours_left()
    assert least == (0.0 if errors else 0.5)
    assert most == (0.0 if following is None else 2.0 - 0.5 * len(errors))


def test_the_curve_goes_on_over_the_trainings_and_the_best_of_them_is_taken(tmp_path):
    finished(tmp_path, 0.5, 0.25, 0.75)
    history = History(Dataset("small", "goop.yaml", 0.5), tmp_path, Extension())
    assert history.best().folder.name == "2"
    assert history.curve()[:4] == [[900.0, 5, 1.0], [1800.0, 10, 0.5], [2700.0, 15, 0.5], [3600.0, 20, 0.25]]


def test_the_last_weights_are_taken_where_the_lowest_validation_is_chance(tmp_path):
    finished(tmp_path, 0.5)
    training = History(Dataset("small", "goop.yaml", 0.5), tmp_path, Extension()).best()
    training.best.with_name("last.ckpt").touch()
    assert training.best.name == "best.ckpt"
    curve = [[float(at), at, error] for at, error in enumerate((0.9, 0.3, 0.8, 0.6, 0.5, 0.4, 0.4, 0.4))]
    report = json.loads((training.folder / "report.json").read_text())
    (training.folder / "report.json").write_text(json.dumps(report | {"curve": curve}))
    assert training.best.name == "last.ckpt"


def test_time_alone_ends_a_training_and_an_extension_starts_at_a_lower_rate():
    dataset = Dataset("goop", "goop.yaml", 26.5, options={"data.batch_size": 2})
    first = new_training(dataset)
    assert first[:3] == ["fit", "--config", "goop.yaml"]
    options = dict(zip(first[3::2], first[4::2], strict=True))
    assert options["--trainer.max_steps"] == "-1"
    assert options["--trainer.max_time"] == "01:02:30:00"
    assert options["--data.batch_size"] == "2"
    later = continued_training(dataset, 1, 0.5, Path("best.ckpt"))
    options = dict(zip(later[3::2], later[4::2], strict=True))
    assert options["--trainer.max_time"] == "00:01:00:00"
    assert float(options["--model.optimizer.init_args.lr"]) == pytest.approx(0.003)
    assert options["--start_from"] == "best.ckpt"


def test_an_extension_lowers_the_rate_of_the_options():
    dataset = Dataset("goop", "goop.yaml", 1, options={"model.optimizer.init_args.lr": 0.004})
    words = continued_training(dataset, 1, 0.5, Path("best.ckpt"))
    assert words.count("--model.optimizer.init_args.lr") == 1
    assert float(words[words.index("--model.optimizer.init_args.lr") + 1]) == pytest.approx(0.002)


def test_trainings_that_go_on_use_the_values_of_extensions(tmp_path):
    more = {"data.generate": {"counts": {"train": 9, "valid": 1, "test": 2}}}
    dataset = Dataset("goop", "goop.yaml", 0.5, options={"data.passes": 2}, extend=more)
    history = History(dataset, tmp_path, Extension(hours=0.5))
    first = json.loads((history.open(1).folder / "words.json").read_text())
    assert "--data.generate" not in first
    shutil.rmtree(tmp_path / "1")
    finished(tmp_path, 0.5)
    later = json.loads((history.open(2).folder / "words.json").read_text())
    assert json.loads(later[later.index("--data.generate") + 1]) == more["data.generate"]
    assert later[later.index("--data.passes") + 1] == "2"
    assert history.dataset_of(1).generation() == ("goop", {})
    assert history.dataset_of(2).generation() == ("goop", more["data.generate"])
    about = describe_data(history.dataset_of(1), history.dataset_of(2))
    assert about.startswith("9 trajectories to train on, 200 of them in the first hours, 1 to validate and 2 to test,")
    assert describe_data(dataset, dataset).startswith("200 trajectories to train on, 10 to validate")


def test_a_training_that_goes_on_from_an_entry_uses_the_values_of_extensions(tmp_path):
    entry = tmp_path / "zoo" / "small"
    entry.mkdir(parents=True)
    card = {"training": {"seconds": 7200, "steps": 7}, "curve": [[900.0, 5, 0.2]]}
    (entry / "card.yaml").write_text(yaml.safe_dump(card))
    dataset = Dataset("small", "goop.yaml", 2.0, extend={"data.passes": 7})
    history = History(dataset, tmp_path / "runs" / "small", Extension(), entry)
    words = json.loads((history.open(1).folder / "words.json").read_text())
    assert words[words.index("--data.passes") + 1] == "7"
    assert "data.passes" not in History(dataset, tmp_path / "fresh", Extension()).dataset_of(1).options


def test_the_shipped_queue_is_read_and_simulates_what_its_configurations_say():
    plan = Plan.read(SCRIPT.with_name("queue.yaml"))
    simulated = {dataset.name: dataset.generation() for dataset in plan.datasets}
    assert simulated["dambreak2d"] == ("dambreak2d", {"counts": {"train": 20, "valid": 3, "test": 8}})
    assert simulated["waterdrop-simulated"] == ("waterdrop", {})
    assert Dataset("waterdrop", "waterdrop.yaml", 1).generation() is None


def test_a_dataset_waits_for_its_data_and_for_the_training_that_it_starts_from(tmp_path):
    plan = Plan.read(SCRIPT.with_name("queue.yaml"))

    def waterdrop(plan: Plan) -> History:
        dataset = plan.select(["waterdrop"]).datasets[0]
        return History(dataset, tmp_path / dataset.name, plan.extension)

    assert waterdrop(plan).waits_for() == "--data waterdrop=FOLDER"
    given = waterdrop(plan.with_data({"waterdrop": str(tmp_path)}))
    assert given.waits_for() == "waterdrop-simulated"
    finished(tmp_path / "waterdrop-simulated", 0.5)
    assert given.waits_for() == ""
    words = json.loads((given.open(1).folder / "words.json").read_text())
    assert words[words.index("--start_from") + 1] == str(tmp_path / "waterdrop-simulated/1/checkpoints/best.ckpt")
    assert words[words.index("--data.path") + 1] == str(tmp_path)
    with pytest.raises(ConfigError, match="has no lava"):
        plan.with_data({"lava": "folder"})


def test_an_entry_of_the_zoo_replaces_the_training_that_a_dataset_starts_from(tmp_path):
    entry = tmp_path / "zoo" / "recorded"
    entry.mkdir(parents=True)
    card = {"training": {"seconds": 900, "steps": 7}, "curve": [[900.0, 7, 0.2, 0.2]]}
    (entry / "card.yaml").write_text(yaml.safe_dump(card))
    dataset = Dataset("recorded", "goop.yaml", 0.5, start="simulated")
    extension = Extension(hours=1.0, gain=0.03, limit=5.0)
    assert History(dataset, tmp_path / "runs/recorded", extension).waits_for() == "simulated"
    history = History(dataset, tmp_path / "runs/recorded", extension, entry)
    assert history.waits_for() == ""
    assert history.planned_hours(1) == pytest.approx(1.25)
    words = json.loads((history.open(1).folder / "words.json").read_text())
    assert words[words.index("--start_from") + 1] == str(tmp_path / "runs/recorded/published")


@pytest.mark.parametrize(("hours", "following"), [(4.02, 1), (4.04, 1), (4.06, None), (4.9, None)])
def test_the_last_training_may_exceed_the_limit_by_a_twentieth_of_its_hours(tmp_path, hours, following):
    entry = tmp_path / "zoo" / "small"
    entry.mkdir(parents=True)
    card = {"training": {"seconds": 3600 * hours, "steps": 7}, "curve": [[900.0, 7, 0.2, 0.2]]}
    (entry / "card.yaml").write_text(yaml.safe_dump(card))
    history = History(Dataset("small", "goop.yaml", 2.0), tmp_path / "runs", Extension(hours=1.0, limit=5.0), entry)
    assert history.next_round() == following


def test_mistakes_in_a_queue_are_named(queue, tmp_path):
    path = queue(1.0)
    with pytest.raises(ConfigError, match=r"has no lava; it has small"):
        Plan.read(path).select(["lava"])
    content = yaml.safe_load(path.read_text())
    for change, complaint in (
        ({"datasets": [dict(content["datasets"][0]) | {"options": {}} for _ in range(2)]}, "small: occurs twice"),
        ({"dataset": []}, "unknown dataset; keys: datasets"),
        ({"datasets": [{"name": "small"}]}, "config"),
        ({"datasets": [content["datasets"][0] | {"hours": 0}]}, "hours = 0 must be a positive number"),
        ({"datasets": [content["datasets"][0] | {"start": "lava"}]}, "small: start = lava is no other dataset"),
        ({"datasets": [content["datasets"][0] | {"start": "small"}]}, "small: start = small is no other dataset"),
    ):
        path.write_text(json.dumps(content | change))
        with pytest.raises(ConfigError, match=complaint):
            Plan.read(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--data", "small"], "--data small: write NAME=FOLDER"),
        (["--data", "small="], "--data small=: write NAME=FOLDER"),
        (["--hours", "0"], "--hours 0.0 must be a positive number"),
        (["--hours", "nan"], "--hours nan must be a positive number"),
        (["--hours", "inf"], "--hours inf must be a positive number"),
        (["--device", "abacus"], "--device abacus"),
        (["--device", "cuda:99"], "This machine has no device 'cuda:99'"),
    ],
    ids=str,
)
def test_mistakes_in_options_are_named_before_anything_is_done(queue, capsys, options, message):
    assert train(queue(1.0), *options) == 1
    assert f"error: {message}" in capsys.readouterr().out
    assert not Path("runs").exists()


def test_what_left_out_datasets_wait_for_is_said(queue, tmp_path, capsys):
    path = queue(1.0)
    entries = [
        {"name": "recorded", "config": "waterdrop.yaml", "hours": 1},
        {"name": "later", "config": "goop.yaml", "hours": 1, "start": "recorded"},
        {"name": "done", "config": "goop.yaml", "hours": 0.5, "publish": False},
    ]
    path.write_text(yaml.safe_dump({"extension": {"hours": 0.5, "limit": 0.5}, "datasets": entries}))
    finished(Path("runs/done"), 0.5)
    assert train(path) == 0
    said = capsys.readouterr().out
    assert "nothing is left to take" in said
    assert "recorded waits for --data recorded=FOLDER." in said
    assert "later waits for the training of recorded." in said
    assert "done waits" not in said


def test_trainings_and_an_extension_become_an_entry_with_their_curve(queue, capsys):
    path = queue(2 / 3600, hours=1 / 3600, gain=-9.0, limit=3.1 / 3600)
    assert train(path) == 0
    assert "Failed: none" in capsys.readouterr().out
    card = Zoo.card("small", "zoo")
    runs = [json.loads(Path(f"runs/small/{n}/report.json").read_text()) for n in (1, 2)]
    assert [len(run["curve"]) >= 1 for run in runs] == [True, True]
    assert len(card["curve"]) == sum(len(run["curve"]) for run in runs)
    assert card["curve"] == sorted(card["curve"])
    assert card["training"]["precision"] == "32-true"
    assert card["training"]["steps"] <= sum(run["training"]["steps"] for run in runs)
    assert Zoo.load("small", "zoo").emulator.calibrated
    before = {file: file.stat().st_mtime_ns for file in Path("runs").rglob("*.ckpt")}
    assert train(path) == 0  # nothing is left
    assert before == {file: file.stat().st_mtime_ns for file in Path("runs").rglob("*.ckpt")}


def test_a_worse_model_does_not_replace_an_entry(queue, capsys, root):
    path = queue(1 / 3600)
    assert train(path) == 0
    folder = Path("zoo/small")
    card = yaml.safe_load((folder / "card.yaml").read_text()) | {"sha256": "of other weights"}
    about = card["about"]
    changed = (
        card | {"about": "a better one", "curve": [[1.0, 1, 0.0]]},
        {key: value for key, value in card.items() if key != "curve"} | {"test": card["test"] | {"mse": 0.0}},
    )
    for better, split in zip(changed, ("validation", "test"), strict=True):
        (folder / "card.yaml").write_text(yaml.safe_dump(better))
        capsys.readouterr()
        assert train(path, "--collect") == 0
        assert f"kept, as its {split} error 0" in capsys.readouterr().out
        assert (folder / "card.yaml").read_text() == yaml.safe_dump(better)
    worse_in_validation = card | {"test": card["test"] | {"mse": 0.0}, "curve": [[1.0, 1, 1e9]]}
    (folder / "card.yaml").write_text(yaml.safe_dump(worse_in_validation))
    assert train(path, "--collect") == 0
    assert Zoo.card("small", "zoo")["test"]["mse"] > 0
    assert Zoo.card("small", "zoo")["about"] == about


def test_the_figures_of_an_entry_are_those_of_its_rounded_weights(queue):
    path = queue(1 / 3600)
    assert train(path) == 0
    model = Zoo.load(Path("zoo/small"))
    assert model.card["weights"] == "float16"
    data = yaml.safe_load(path.read_text())["datasets"][0]["options"]["data.path"]
    scenes = iterate_test_scenes(model, None, Path(data))
    for stated, window in zip(model.card["per_trajectory"], scenes, strict=True):
        metric = MSE()
        metric.update(window, model.rollout(window.initial, window.target.shape[1]))
        assert stated["mse"] == pytest.approx(metric.per_trajectory()[0]["mse"], rel=1e-6)


def test_an_entry_that_has_the_best_weights_keeps_what_was_measured_of_them(queue, capsys):
    path = queue(1 / 3600)
    assert train(path) == 0
    card_path, picture = Path("zoo/small/card.yaml"), Path("zoo/small/worst.png")
    card = yaml.safe_load(card_path.read_text())
    facts = {"failures": "Late splashes become dust.", "superseded_by": "other"}
    facts |= {"speed": [card["speed"][0] | {"hardware": "a GPU"}, *card["speed"]]}
    picture.write_bytes(b"looked at")
    card_path.write_text(yaml.safe_dump(card | facts | {"curve": []}))
    content = yaml.safe_load(path.read_text())
    content["datasets"][0]["goal"] = 0.25
    path.write_text(yaml.safe_dump(content))
    capsys.readouterr()
    for _ in range(2):
        assert train(path, "--collect") == 0
        assert "small: its best weights are already in zoo/small." in capsys.readouterr().out
        assert yaml.safe_load(card_path.read_text()) == card | facts | {"goal": 0.25}
        assert picture.read_bytes() == b"looked at"
        written = card_path.stat().st_mtime_ns
    assert train(path, "--collect") == 0
    assert card_path.stat().st_mtime_ns == written  # there is nothing to change


def test_times_of_the_same_network_stay_on_the_card(queue):
    path = queue(1 / 3600)
    assert train(path) == 0
    folder = Path("zoo/small")
    card = yaml.safe_load((folder / "card.yaml").read_text())
    elsewhere = card["speed"][0] | {"hardware": "a GPU"}
    former = card | {"sha256": "of other weights", "speed": [elsewhere], "curve": [[1.0, 1, 1e9]]}
    (folder / "card.yaml").write_text(yaml.safe_dump(former))
    assert train(path, "--collect") == 0
    assert Zoo.card("small", "zoo")["speed"] == [elsewhere]
    (folder / "card.yaml").write_text(yaml.safe_dump(former))
    (folder / "config.yaml").write_text((folder / "config.yaml").read_text().replace("width: 4", "width: 8"))
    assert train(path, "--collect") == 0
    assert [entry["hardware"] for entry in Zoo.card("small", "zoo")["speed"]] == [card["speed"][0]["hardware"]]


def test_an_entry_that_is_replaced_while_the_simulator_is_measured_keeps_its_card(queue, monkeypatch, capsys):
    from nmpm.zoo.queue import collection

    def replace_meanwhile(entry, *_):
        card = yaml.safe_load((entry / "card.yaml").read_text())
        (entry / "card.yaml").write_text(yaml.safe_dump(card | {"sha256": "of others"}))
        return {"mse": 0.1}

    monkeypatch.setattr(collection, "_twin", replace_meanwhile)
    monkeypatch.setattr(Dataset, "generation", lambda _: ("small", {}))
    monkeypatch.setattr(collection, "describe_data", lambda *_: "")
    monkeypatch.setattr(collection, "kept_facts", lambda *_: {"simulation": {"seed": 0}})
    monkeypatch.setattr("nmpm.data.catalog.ensure", lambda *_, **__: Path())
    assert train(queue(1 / 3600)) == 1
    assert "its weights were replaced" in capsys.readouterr().out
    assert "twin" not in Zoo.card("small", "zoo")


def test_few_validations_do_not_replace_an_entry_of_many(queue, capsys):
    path = queue(1 / 3600)
    assert train(path) == 0
    folder = Path("zoo/small")
    card = yaml.safe_load((folder / "card.yaml").read_text()) | {"sha256": "of other weights"}
    assert len(card["curve"]) < 3
    bad = [[float(at), at, 1e9] for at in range(1, 4)]
    (folder / "card.yaml").write_text(yaml.safe_dump(card | {"curve": bad}))
    capsys.readouterr()
    assert train(path, "--collect") == 0
    assert f"has too few validations to be compared, {len(card['curve'])} of 3" in capsys.readouterr().out
    assert Zoo.card("small", "zoo")["curve"] == bad


def test_facts_of_the_simulator_stay_as_long_as_the_simulation_does():
    former = {"simulation": {"seed": 0}, "twin": {"mse": 0.1}, "floor": {"mse": 0.01}, "quality": {"emd": 1.0}}
    assert simulator_facts(former, {"simulation": {"seed": 0}}) == {"twin": {"mse": 0.1}, "floor": {"mse": 0.01}}
    assert simulator_facts(former, {"simulation": {"seed": 1}}) == {}
    assert simulator_facts({"twin": {"mse": 0.1}}, {}) == {}  # recorded
    few, many, others = ({"seed": 0, "counts": {"train": n, "test": test}} for n, test in ((2, 3), (9, 3), (2, 4)))
    assert simulator_facts(former | {"simulation": few}, {"simulation": many})["twin"] == {"mse": 0.1}
    assert simulator_facts(former | {"simulation": few}, {"simulation": others}) == {}
    redrawn = many | {"redrawn": {"train": {"5": 1}}}  # of the training trajectories that were added
    assert simulator_facts(former | {"simulation": few}, {"simulation": redrawn})["twin"] == {"mse": 0.1}
    assert simulator_facts({}, {"simulation": {"seed": 0}}) == {}


def test_a_dataset_that_another_process_has_is_left_to_it(queue, capsys):
    path = queue(1 / 3600)
    script = runpy.run_path(str(SCRIPT))
    with script["taken"](Path("runs/small")) as mine:
        assert mine
        assert script["main"](words(path)) == 0
    assert "nothing is left to take" in capsys.readouterr().out
    assert not Path("runs/small/1").exists()


def test_where_no_training_is_left_it_goes_on_from_the_published_entry(queue, tmp_path):
    assert train(queue(1 / 3600, hours=1 / 3600, gain=-9.0, limit=2.1 / 3600)) == 0
    first = Zoo.card("small", "zoo")
    hours = first["training"]["seconds"] / 3600
    shutil.rmtree("runs")
    assert train(queue(1 / 3600, hours=1 / 3600, gain=-9.0, limit=hours + 0.5 / 3600)) == 0  # the limit is reached
    assert not Path("runs/small/1").exists()
    path = queue(1 / 3600, hours=1 / 3600, gain=-9.0, limit=hours + 1.1 / 3600)
    assert train(path) == 0
    words = json.loads(Path("runs/small/1/words.json").read_text())
    assert words[words.index("--start_from") + 1] == str(Path("runs/small/published"))
    copy = Path("runs/small/published")
    assert yaml.safe_load((copy / "card.yaml").read_text()) == first
    plan = Plan.read(path)
    history = History(plan.datasets[0], Path("runs/small"), plan.extension, Path("zoo/small"))
    assert history.curve()[: len(first["curve"])] == first["curve"]
    assert history.planned_hours(1) == pytest.approx(hours + 1 / 3600)
    card = Zoo.card("small", "zoo")
    published, found = lowest_errors(first["curve"], Training(Path("runs/small/1")).curve())
    assert (card == first) is (published < found)
    if card != first:
        assert card["training"]["steps"] > first["training"]["steps"]
    assert train(path, "--fresh") == 0  # what has been started goes on as it was
    assert not Path("runs/small/2").exists()


def test_datasets_that_lack_hours_come_first(tmp_path):
    script = runpy.run_path(str(SCRIPT))
    for name, seconds in {"long": 7200, "short": 1800, "new": None}.items():
        if seconds is not None:
            (tmp_path / "zoo" / name).mkdir(parents=True)
            card = {"training": {"seconds": seconds, "steps": 7}, "curve": [[900.0, 5, 0.2]]}
            (tmp_path / "zoo" / name / "card.yaml").write_text(yaml.safe_dump(card))
    datasets = tuple(Dataset(name, "goop.yaml", 2.0) for name in ("long", "short", "new"))
    plan = Plan(datasets, Extension(hours=1.0, gain=0.03, limit=5.0))
    chosen = script["parse"](["--zoo", str(tmp_path / "zoo"), "--runs", str(tmp_path / "runs")])
    order = [history.dataset.name for history, _ in script["ready"](plan, chosen, set())]
    assert order == ["short", "new", "long"]


def test_data_of_the_next_trainings_are_simulated_and_nothing_is_trained(tmp_path, monkeypatch, capsys):
    made = []
    monkeypatch.setattr("nmpm.data.catalog.ensure", lambda name, **options: made.append((name, options)) or tmp_path)
    monkeypatch.chdir(tmp_path)
    more = {"data.generate": {"counts": {"train": 9}}}
    entries = [{"name": name, "config": "goop.yaml", "hours": 1, "extend": more} for name in ("goop", "done", "again")]
    for name, seconds in {"done": 7200, "again": 3600}.items():
        (tmp_path / "zoo" / name).mkdir(parents=True)
        card = {"training": {"seconds": seconds, "steps": 7}, "curve": [[900.0, 5, 0.2]]}
        (tmp_path / "zoo" / name / "card.yaml").write_text(yaml.safe_dump(card))
    path = tmp_path / "queue.yaml"
    path.write_text(json.dumps({"extension": {"hours": 1, "limit": 2}, "datasets": entries}))
    assert train(path, "--simulate") == 0
    assert [name for name, _ in made] == ["goop", "goop"]
    assert ["counts" in options for _, options in made] == [False, True]  # the second goes on from weights
    assert not list((tmp_path / "runs").rglob("words.json"))


def test_fresh_trainings_ignore_the_published_entry(queue):
    path = queue(1 / 3600)
    assert train(path) == 0
    shutil.rmtree("runs")
    assert train(path, "--fresh") == 0
    assert "--start_from" not in json.loads(Path("runs/small/1/words.json").read_text())


@pytest.mark.parametrize(
    ("seconds", "errors", "hours", "following"),
    [
        (1800, [], 1.5, 1),  # what it lacks
        (7200, [], 1.0, 1),  # an extension
        (14400, [], None, None),  # its hours are over
        (1800, [0.1], 1.0, 2),
        (1800, [0.199], 1.0, None),  # gained too little
    ],
)
def test_hours_of_the_entry_count_and_its_error_is_to_be_improved(tmp_path, seconds, errors, hours, following):
    entry = tmp_path / "zoo" / "small"
    entry.mkdir(parents=True)
    card = {"training": {"seconds": seconds, "steps": 7}, "curve": [[900.0, 5, 0.2]]}
    (entry / "card.yaml").write_text(yaml.safe_dump(card))
    folder = tmp_path / "runs" / "small"
    if errors:
        folder.mkdir(parents=True)
        shutil.copytree(entry, folder / "published")
    finished(folder, *errors)
    history = History(Dataset("small", "goop.yaml", 2.0), folder, Extension(hours=1.0, gain=0.03, limit=4.0), entry)
    assert history.next_round() == following
    if hours is not None:
        assert history.hours_of(len(errors) + 1) == hours


def last_round(**stated) -> dict:
    """A card of a model that was trained for two hours."""
    stated = {"hours": 1.0, "gain": 0.02, "options": {}} | stated
    return {"training": {"seconds": 7200}, "curve": [[900.0, 5, 0.2]], "last_round": stated}


@pytest.mark.parametrize(
    ("stated", "hours", "following"),
    [
        ({"gain": 0.05}, 2.0, 1),
        ({"gain": 0.02}, 2.0, None),
        ({"gain": -0.1}, 2.0, None),
        ({"gain": 0.02, "options": {"model.mirror": "[0]"}}, 2.0, 1),  # a round of another kind
        ({"gain": 0.02}, 3.0, 1),  # the first hours are not over
    ],
    ids=str,
)
def test_an_entry_whose_last_round_gained_too_little_is_not_trained_again(tmp_path, stated, hours, following):
    entry = tmp_path / "zoo" / "small"
    entry.mkdir(parents=True)
    (entry / "card.yaml").write_text(yaml.safe_dump(last_round(**stated)))
    dataset = Dataset("small", "goop.yaml", hours, options={"data.path": "anywhere"})
    extension = Extension(hours=1.0, gain=0.03, limit=4.0)
    assert History(dataset, tmp_path / "runs", extension, entry).next_round() == following
    assert History(dataset, tmp_path / "runs", extension).next_round() == 1  # --fresh


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"last_round": [1]}, "last_round"),
        ({"last_round": {"hours": 1.0, "gain": "much"}}, "last_round"),
        ({"last_round": {"hours": 1.0, "gain": float("nan")}}, "last_round"),
        ({"training": {"seconds": "long"}}, "training"),
        ({"training": 5}, "training"),
        ({"curve": [1, 2]}, "curve"),
    ],
    ids=str,
)
def test_a_malformed_card_is_named(queue, tmp_path, capsys, change, key):
    (tmp_path / "zoo" / "small").mkdir(parents=True)
    (tmp_path / "zoo" / "small" / "card.yaml").write_text(yaml.safe_dump(last_round() | change))
    assert train(queue(1.0), "--status") == 1
    assert f"small/card.yaml: {key} should be" in capsys.readouterr().out


@pytest.mark.parametrize("value", ["last_round", "training"])
def test_what_a_card_leaves_empty_counts_as_not_stated(tmp_path, value):
    (tmp_path / "small").mkdir()
    (tmp_path / "small" / "card.yaml").write_text(yaml.safe_dump(last_round() | {value: None}))
    history = History(Dataset("small", "goop.yaml", 2.0), tmp_path / "runs", Extension(), tmp_path / "small")
    assert history.next_round() == 1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gain": 3}, "is a share"),
        ({"gain": float("nan")}, "gain = nan"),
        ({"rate": 0}, "rate = 0"),
        ({"hours": -1}, "hours = -1"),
        ({"limit": "5"}, "limit = '5'"),
    ],
    ids=str,
)
def test_values_of_an_extension_are_checked(values, message):
    with pytest.raises(ConfigError, match=message):
        from_plain(Extension, values, "extension")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"hours": float("nan")}, "hours = nan"),
        ({"goal": float("inf")}, "goal = inf"),
        ({"publish": "no"}, "publish = 'no'"),
        ({"options": None}, "options = None should be keys and values"),
        ({"extend": []}, "extend = .. should be keys and values"),
    ],
    ids=str,
)
def test_values_of_a_dataset_are_checked(values, message):
    with pytest.raises(ConfigError, match=message):
        from_plain(Dataset, {"name": "small", "config": "goop.yaml", "hours": 1.0} | values, "datasets")


def test_a_variant_starts_from_the_training_of_its_dataset(tmp_path):
    finished(tmp_path / "goop", 0.5)
    history = History(Dataset("goop/fast", "goop.yaml", 0.5, start="goop"), tmp_path / "goop" / "fast", Extension())
    assert not history.waits_for()


def test_a_copy_of_an_entry_that_no_training_started_from_is_not_taken(tmp_path):
    folder, entry = tmp_path / "runs", tmp_path / "zoo"
    for place in (folder / "published", entry):
        place.mkdir(parents=True)
        (place / "card.yaml").write_text(yaml.safe_dump(last_round()))
    dataset = Dataset("small", "goop.yaml", 2.0)
    fresh = History(dataset, folder, Extension())
    assert fresh.starting_entry is None
    assert fresh.hours_of(1) == 2.0
    assert History(dataset, folder, Extension(), entry).starting_entry.folder == entry
    fresh.open(1)
    assert fresh.starting_entry is None


def test_an_interrupted_collection_ends_the_queue_and_the_next_call_makes_up_for_it(queue, monkeypatch, capsys):
    path = queue(1 / 3600)
    from nmpm.cli import main as run

    with monkeypatch.context() as patched:
        patched.setattr("nmpm.cli.main", lambda given: 130 if given[0] == "test" else run(given))
        assert train(path) == 130
    assert not Path("zoo/small").exists()
    assert train(path) == 0
    assert "now in zoo/small" in capsys.readouterr().out
    written = Path("zoo/small/card.yaml").stat().st_mtime_ns
    assert train(path) == 0  # it is collected
    assert Path("zoo/small/card.yaml").stat().st_mtime_ns == written
    assert "small:" not in capsys.readouterr().out


def test_a_round_with_other_options_is_trained_though_the_last_one_gained_nothing(tmp_path):
    finished(tmp_path, 0.5, 0.6)
    extension = Extension(hours=0.5, gain=0.03, limit=2.0)
    history = History(Dataset("small", "goop.yaml", 0.5, extend={"model.mirror": [0]}), tmp_path, extension)
    assert history.next_round() == 3
    words = ["fit", "--config", "x.yaml", "--trainer.max_steps", "-1", "--model.mirror", "[0]", "--start_from", "y"]
    (tmp_path / "2" / "words.json").write_text(json.dumps([*words, "--model.optimizer.init_args.lr", "0.1"]))
    assert history.next_round() is None


def test_a_collection_of_an_earlier_version_is_not_made_again(tmp_path):
    finished(tmp_path, 0.5)
    history = History(Dataset("small", "goop.yaml", 0.5), tmp_path, Extension())
    assert not is_collected(history)
    (tmp_path / "collected").mkdir()
    merged = tmp_path / "collected" / "merged.json"
    merged.touch()
    os.utime(merged, (1.0, 1.0))  # of a training before
    assert not is_collected(history)
    os.utime(merged)
    assert is_collected(history)
    (tmp_path / "collected" / "collected.txt").write_text("0")
    assert not is_collected(history)


def test_a_collection_that_always_fails_keeps_no_other_dataset_from_training(queue, monkeypatch, capsys):
    path = queue(1 / 3600)
    assert train(path) == 0
    (Path("runs/small/collected/collected.txt")).unlink()
    (Path("runs/small/collected/merged.json")).write_text("{")
    content = yaml.safe_load(path.read_text())
    content["datasets"].append(content["datasets"][0] | {"name": "other"})
    path.write_text(json.dumps(content))
    monkeypatch.setattr("nmpm.zoo.queue.collection.read_checkpoint", lambda _: {"nmpm_digest": "of others"})
    monkeypatch.setattr("nmpm.zoo.queue.collection.rounded_checkpoint", lambda _: {}["a mistake"])
    assert train(path) == 1
    said = capsys.readouterr().out
    assert "a mistake" in said
    assert "other, training 1" in said


def test_the_twin_is_measured_again_for_other_test_scenes(tmp_path, monkeypatch):
    from nmpm.zoo.measures.simulator import Twin
    from nmpm.zoo.queue import collection

    measured = []
    monkeypatch.setattr(collection, "load_entry", lambda folder: folder)
    monkeypatch.setattr(collection, "measure_twin", lambda *_: measured.append(1) or Twin(5, 10, {"mse": 0.1}))

    def twin(**counts):
        stated = {"preset": {"name": "small"}, "seed": 0, "revision": 1, "counts": {"train": 1, "test": 1} | counts}
        monkeypatch.setattr(collection, "read_card", lambda _: {"simulation": stated})
        dataset = Dataset("small", "goop.yaml", 1.0)
        return collection._twin(tmp_path / "zoo", History(dataset, tmp_path, Extension()), dataset)

    assert twin()["mse"] == 0.1
    assert twin(train=9)["mse"] == 0.1
    assert len(measured) == 1
    assert twin(test=2)["mse"] == 0.1
    assert len(measured) == 2


def test_the_card_states_what_a_further_round_gained_though_its_weights_stay(queue, capsys):
    assert train(queue(1 / 3600)) == 0
    runs, card = Path("runs/small"), Path("zoo/small/card.yaml")
    shutil.rmtree(runs)
    content = yaml.safe_load(card.read_text())
    assert "last_round" not in content
    content["curve"] = [[1.0, 1, 1e-12, 1e-12]]  # better than any
    card.write_text(yaml.safe_dump(content))
    path = queue(1 / 3600, hours=1 / 3600, gain=0.03, limit=9.0)
    assert train(path) == 0
    assert "the entry is kept" in capsys.readouterr().out
    stated = yaml.safe_load(card.read_text())
    assert stated["last_round"]["gain"] < 0
    assert set(stated["last_round"]["options"]) == set(TINY)  # not the folder of the data
    assert {key: value for key, value in stated.items() if key != "last_round"} == content
    assert "did not lower its validation error" in Path("zoo/small/README.md").read_text()
    shutil.rmtree(runs)
    assert train(path) == 0  # a checkout without the trainings knows it from the card
    assert not (runs / "1").exists()


def test_planned_hours_read_the_card_of_the_entry_once(tmp_path, monkeypatch):
    entry = tmp_path / "small"
    entry.mkdir()
    card = {"training": {"seconds": 1800, "steps": 7}, "curve": [[900.0, 5, 0.2]]}
    read = []
    monkeypatch.setattr("nmpm.zoo.queue.published.read_yaml", lambda path: read.append(path) or card)
    (entry / "card.yaml").touch()
    history = History(Dataset("small", "goop.yaml", 2.0), tmp_path / "runs", Extension(hours=1.0), entry)
    assert history.planned_hours(3) == 0.5 + 1.5 + 1.0 + 1.0
    assert read == [entry / "card.yaml"]


@pytest.mark.parametrize("trained", [True, False], ids=["best weights", "no weights"])
def test_a_diverged_training_goes_back_and_slows_down(tmp_path, trained):
    training = Training(tmp_path / "1")
    training.start(new_training(Dataset("small", "goop.yaml", 1.0)))
    (tmp_path / "1" / "checkpoints").mkdir()
    last = tmp_path / "1" / "checkpoints" / "last.ckpt"
    last.write_text("diverged")
    if trained:
        training.best.write_text("best")
    assert [training.slow_down(0.5), training.slow_down(0.5)] == [3e-3, 1.5e-3]
    assert last.is_file() == trained
    assert not trained or last.read_text() == "best"
    command = training.command()
    assert command[command.index("--model.optimizer.init_args.lr") + 1] == "0.0015"
    assert command.count("--model.optimizer.init_args.lr") == 1


def test_the_precision_is_what_was_computed_in_and_before_that_what_is_configured(tmp_path):
    training = Training(tmp_path / "1")
    training.start(new_training(Dataset("small", "goop.yaml", 1.0)))
    assert training.precision() == "bf16-mixed"
    (tmp_path / "1" / "report.json").write_text(json.dumps({"training": {"precision": "32-true"}}))
    assert training.precision() == "32-true"


@pytest.mark.parametrize(("divergences", "done"), [(1, True), (4, False)])
def test_the_queue_slows_a_diverging_training_down(queue, monkeypatch, capsys, divergences, done):
    path, rates = queue(1 / 3600), []

    def diverge_at_first(command):
        if command[0] != "fit" or len(rates) == divergences:
            return main(command)
        rates.append(float(command[command.index("--model.optimizer.init_args.lr") + 1]) if rates else None)
        return 3

    monkeypatch.setattr("nmpm.cli.main", diverge_at_first)
    assert (train(path) == 0) == done
    assert capsys.readouterr().out.count("has diverged") == min(divergences, 3)
    assert rates[1:] == [3e-3, 1.5e-3, 0.75e-3][: len(rates) - 1]
    if done:
        configuration = yaml.safe_load(Path("runs/small/1/config.yaml").read_text())
        assert configuration["model"]["optimizer"]["init_args"]["lr"] == 3e-3


@pytest.mark.slow
def test_a_killed_queue_goes_on_within_its_time_and_the_rate_comes_down_once(queue):
    path = queue(8 / 3600)
    last = Path("runs/small/1/checkpoints/last.ckpt")
    command = [sys.executable, str(SCRIPT), *words(path, "--threads", "1")]
    first = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    end = time.monotonic() + 120
    while not last.is_file() and time.monotonic() < end:
        time.sleep(0.1)
    time.sleep(1)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    assert last.is_file()
    assert train(path) == 0
    training = json.loads(Path("runs/small/1/report.json").read_text())["training"]
    assert training["seconds"] >= 8
    rates = []
    for table in sorted(Path("runs/small/1/logs").glob("version_*/metrics.csv")):
        with table.open() as file:
            rates.append([float(row["lr-SOAP"]) for row in csv.DictReader(file) if row.get("lr-SOAP")])
    assert len(rates) == 2
    # How far it comes down depends on how long the last step takes: the rate is that of the time at the step's start.
    assert rates[1][-1] < 0.2 * max(rates[0])
    assert rates[1] == sorted(rates[1], reverse=True)
    assert max(rates[1]) <= max(rates[0])
