"""The shipped configurations are the integration tests: each trains, tests and reports under a tiny budget."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from nmpm._support.machine import computes_bfloat16
from nmpm._support.shipped import config_names, find_config, shipped_folder
from nmpm.cli import main
from nmpm.cli.run_training import EmulatorCLI
from nmpm.cli.training_options import known_options
from nmpm.data.format import Split, write_metadata, write_split
from nmpm.errors import ConfigError
from nmpm.training import EmulatorModule
from nmpm.zoo import Zoo, publish
from tests.made_up import made_up_metadata, made_up_trajectory

TINY_GOOP = ["--data.generate", '{"counts": {"train": 2, "valid": 1, "test": 1}, "frames": 40}']
IN_EACH_RUN = ("goop.yaml", "heatedchannel.yaml")
CONFIGS = [pytest.param(name, marks=[] if name in IN_EACH_RUN else pytest.mark.slow) for name in config_names()]
TINY = [
    *("--trainer.max_steps", "2", "--trainer.val_check_interval", "2", "--data.batch_size", "2"),
    *("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false", "--model.unroll", "1"),
]
WATERDROP = ["--config", "waterdrop.yaml", *TINY]


@pytest.fixture(scope="session")
def home(tmp_path_factory):
    """One cache for all tests, so that the tiny goop is simulated once."""
    return tmp_path_factory.mktemp("home")


@pytest.fixture(autouse=True)
def elsewhere(home, tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(home))
    monkeypatch.chdir(tmp_path)


def source(config: str, make_dataset) -> list[str]:
    data = yaml.safe_load(find_config(config).read_text())["data"]
    if data.get("name"):
        return TINY_GOOP
    fields = tuple(data.get("fields", ()))
    made = make_dataset(train=((40, 9),) * 2, valid=((40, 9),), test=((40, 9),), statics=2 * len(fields), fields=fields)
    return ["--data.path", str(made)]


@pytest.mark.parametrize("config", CONFIGS)
def test_every_shipped_configuration_runs_to_its_report(config, make_dataset, capsys):
    data = [*source(config, make_dataset), "--trainer.default_root_dir", "run"]
    assert main(["fit", "--config", config, *TINY, *data]) == 0
    run = Path("run")
    report = json.loads((run / "report.json").read_text())
    assert report["training"]["steps"] == 2
    for kind in ("", "still/", "free_fall/"):
        assert report["test"][f"{kind}mse"] >= 0
        assert report["test"][f"{kind}mse@32"] >= 0
    stored = 41 if "--data.generate" in data else 40
    assert len((run / "errors.csv").read_text().splitlines()) == 1 + stored - 2
    assert Image.open(run / "rollout.png").width > 300
    assert Image.open(run / "rollout.gif").n_frames > 1
    assert list(run.glob("logs/version_0/metrics.csv"))
    assert list(run.glob("logs/version_0/events.out.tfevents.*"))
    assert "free fall" in capsys.readouterr().out


@pytest.mark.parametrize("config", CONFIGS)
def test_a_path_replaces_the_data_of_every_shipped_configuration(config, make_dataset, monkeypatch):
    built = []
    monkeypatch.setattr(EmulatorCLI, "_run_subcommand", lambda cli, _: built.append((cli.datamodule, cli.model)))
    fields = tuple(yaml.safe_load(find_config(config).read_text())["data"].get("fields", ()))
    folder = make_dataset(statics=2, fields=fields, dim=3 if "3d" in config else 2)
    assert main(["fit", "--config", config, "--data.path", str(folder), "--trainer.accelerator", "cpu"]) == 0
    ((data, model),) = built
    assert data.description == folder.name
    assert model.emulator.scene == data.scene


def test_without_validations_the_last_weights_are_tested_and_so_are_members(make_dataset, capsys):
    data = [*source("waterdrop.yaml", make_dataset), "--trainer.default_root_dir", "run"]
    words = [*WATERDROP, *data, "--trainer.limit_val_batches", "0"]
    words += ["--resume.every_n_train_steps", "2"]
    assert main(["fit", *words]) == 0
    ended = json.loads(Path("run/report.json").read_text())["test"]
    assert main(["test", *words, "--ckpt_path", "last", "--members", "2"]) == 0
    report = json.loads(Path("run/report.json").read_text())
    assert report["test"] == ended
    assert report["ensemble"]["members"] == 2
    assert report["ensemble"]["scores"]["density"]["crps"] >= 0
    assert "members, starts displaced by 0.1 cells" in " ".join(capsys.readouterr().out.split())
    assert main(["rollout", "run", "--frames", "2", "--particles", "20"]) == 0


def test_without_a_test_split_the_report_says_that_nothing_was_tested(make_dataset, capsys):
    folder = make_dataset(train=((40, 9),) * 2, valid=((40, 9),), test=())
    words = [*WATERDROP, "--data.path", str(folder), "--trainer.default_root_dir", "run"]
    assert main(["fit", *words]) == 0
    assert f"Not tested: {folder.name} has no test split." in capsys.readouterr().out
    report = json.loads(Path("run/report.json").read_text())
    assert report["not_tested"] == f"{folder.name} has no test split."
    assert "test" not in report
    assert report["curve"]
    assert main(["test", *words, "--ckpt_path", "best"]) == 1
    assert "no test.h5 there" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_the_test_that_ends_a_training_is_of_the_averaged_weights_of_the_best_checkpoint(make_dataset):
    """Loaded by Lightning into the trainer that has just trained, it would be of the raw ones."""
    data = [*TINY_GOOP, "--trainer.default_root_dir", "run"]
    words = ["--config", "tutorial.yaml", *TINY, *data, "--trainer.max_steps", "3", "--trainer.val_check_interval", "3"]
    assert main(["fit", *words, "--model.optimizer.lr", "0.1", "--model.schedule.warmup", "0"]) == 0
    ended = json.loads(Path("run/report.json").read_text())["test"]
    assert main(["test", *words, "--ckpt_path", "best"]) == 0
    assert json.loads(Path("run/report.json").read_text())["test"] == ended
    assert main(["rollout", "run", "--frames", "2", "--particles", "20"]) == 0


JUNK = r"Seed set|available: |[Tt]ip: |Restor|Loaded model|stopped: |Precision|LeafSpec|FLOPs|v_num|Epoch|sync_dist"


def test_the_console_shows_the_run_and_the_users_warnings_alone(make_dataset):
    Path("mine.py").write_text(
        "import warnings\nimport lightning.pytorch\nfrom lightning.pytorch import Callback\nclass Mine(Callback):\n"
        "    def on_train_start(self, *_):\n        warnings.warn('look out')\n"
        "        warnings.warn_explicit('mind', UserWarning, lightning.pytorch.__file__, 7)\n"
    )
    averaging = {"class_path": "lightning.pytorch.callbacks.EMAWeightAveraging", "init_args": {"decay": 0.9}}
    Path("mine.yaml").write_text(yaml.safe_dump({"trainer": {"callbacks": [averaging, {"class_path": "mine.Mine"}]}}))
    words = ["fit", *WATERDROP, "--config", "mine.yaml", *source("waterdrop.yaml", make_dataset)]
    shown = [*words, "--trainer.enable_progress_bar", "true", "--trainer.default_root_dir", "run"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([os.environ.get("PYTHONPATH", ""), "."])}
    run = subprocess.run(
        [sys.executable, "-m", "nmpm", *shown], capture_output=True, text=True, check=True, env=environment
    )
    contradiction, shared, advice, *others = run.stderr.splitlines()
    assert contradiction == "Warning: these data contradict themselves:"
    assert shared.startswith("  - shared trajectories: train and valid: 1 of 1 trajectories are the same")
    assert "nmpm inspect" in advice
    assert others == ["warning: look out", "warning: mind"]
    lines = run.stdout.replace("\r", "\n").splitlines()
    assert lines.pop(0).startswith("Data: dataset. Model: UNet, ")
    assert computes_bfloat16(torch.device("cpu")) or lines.pop(0).startswith("bfloat16 is emulated ")
    assert lines.pop(0).startswith("Files: run.")
    *lines, rollout, trade, keep = lines
    assert lines[-2:] == ["written to run: report.json, errors.csv, rollout.png, rollout.gif", "next:"]
    assert rollout.startswith("  nmpm rollout run --data ")
    assert " --models run " in trade
    assert keep.startswith("  nmpm zoo add run NAME ")
    assert not re.search(JUNK, run.stdout + run.stderr)


def test_every_part_can_be_swapped_by_class_name(make_dataset):
    swaps = [
        *("--model.processor", "nmpm.processors.FNO", "--model.processor.modes", "4", "--model.processor.width", "4"),
        *("--model.transfer", "nmpm.transfer.Quadratic", "--model.decoder", "nmpm.decoders.Flip"),
        *("--model.optimizer", "torch.optim.AdamW", "--model.optimizer.lr", "0.003"),
        *("--trainer.logger", "lightning.pytorch.loggers.CSVLogger", "--trainer.logger.save_dir", "logs"),
    ]
    data = source("waterdrop.yaml", make_dataset)
    assert main(["fit", *WATERDROP, *data, *swaps, "--trainer.default_root_dir", "run"]) == 0
    saved = EmulatorModule.load_from_checkpoint(next(Path().rglob("best.ckpt")), weights_only=True)
    assert type(saved.emulator.recipe.processor).__name__ == "FNO"
    assert saved.emulator.recipe.processor.modes == 4
    assert type(saved.emulator.transfer).__name__ == "Quadratic"
    assert type(saved.emulator.decoder).__name__ == "Flip"
    assert list(Path("logs").rglob("metrics.csv"))
    assert not list(Path().rglob("events.out.tfevents.*"))


@pytest.mark.slow
def test_soap_refuses_complex_weights_and_names_an_optimizer_that_takes_them(make_dataset, capsys):
    words = ["fit", *WATERDROP, *source("waterdrop.yaml", make_dataset)]
    fno = ["--model.processor", "nmpm.processors.FNO", "--model.processor.modes", "4", "--model.processor.width", "4"]
    assert main([*words, *fno]) == 1
    assert "complex weights, such as FNO's: --model.optimizer torch.optim.Adam" in capsys.readouterr().err
    assert main([*words, *fno, "--model.optimizer", "torch.optim.Adam", "--model.optimizer.lr", "1.5e-3"]) == 0


def test_a_run_goes_on_validates_tests_predicts_and_becomes_a_zoo_entry(make_dataset, tmp_path, capsys):
    data = [*source("waterdrop.yaml", make_dataset), "--trainer.default_root_dir", "run"]
    assert main(["fit", *WATERDROP, *data, "--resume.every_n_train_steps", "1"]) == 0
    changed = ["--model.processor.width", "8", "--ckpt_path", "last"]
    for command in ("fit", "test"):
        assert main([command, *WATERDROP, *data, *changed]) == 1
        assert "The checkpoint has model.processor.width = 32, not 8." in capsys.readouterr().err
    more = ["--trainer.max_steps", "4", "--ckpt_path", "last", "--resume.every_n_train_steps", "1"]
    assert main(["fit", *WATERDROP, *data, *more]) == 0
    assert json.loads(Path("run/report.json").read_text())["training"]["steps"] == 4
    checked = [*WATERDROP, *data, "--ckpt_path", "run/checkpoints/best.ckpt"]
    trained = json.loads(Path("run/report.json").read_text())["training"]
    best = torch.load("run/checkpoints/best.ckpt", weights_only=True)["callbacks"]["ReportWriter"]
    assert trained["seconds"] >= round(best["trained_seconds"], 1)
    capsys.readouterr()
    for command, title, end in (
        ("validate", "dataset: validation error ×10⁻³", "before using it."),  # no better than a trivial predictor
        ("test", "dataset: test error ×10⁻³", "written to run: report.json, errors.csv, rollout.png, rollout.gif"),
        ("predict", "Data: dataset.", "written to run/predictions.h5; to draw them: nmpm render run/predictions.h5"),
    ):
        assert main([command, *checked]) == 0
        said = capsys.readouterr().out
        assert title in said
        assert said.rstrip().endswith(end)
        assert "DataLoader" not in said  # of Lightning's own table
    assert json.loads(Path("run/report.json").read_text())["training"]["steps"] == best["trained_steps"] > 0
    predictions = Split(Path("run/predictions.h5"))
    assert len(predictions) == 1
    assert predictions.read(0).position.shape == (40, 9, 2)
    assert main(["render", "run/predictions.h5"]) == 0
    assert main(["stress", "run/checkpoints/best.ckpt", "--groups", "poison", "--report", "run"]) == 0
    assert main(["zoo", "--root", "zoo", "add", "run", "drop/tiny"]) == 0
    stress = {"size": "quick", "passed": 5, "failed": []}
    assert Zoo.card("drop/tiny", root=tmp_path / "zoo")["stress"] == stress
    assert "with these constraints: 5 of 5 pass, quick; with the" in Path("zoo/drop/tiny/README.md").read_text()
    assert main(["zoo", "--root", "zoo", "add", "run", "drop/tiny"]) == 1
    assert "exists" in capsys.readouterr().err
    model = Zoo.load("drop/tiny", root=tmp_path / "zoo")
    trained = EmulatorModule.load_from_checkpoint("run/checkpoints/best.ckpt", weights_only=True).emulator.eval()
    state = model.example(count=50)
    from nmpm import rollout
    from nmpm.zoo.publish import NOTICED, round_network

    assert model.card["weights"] == "float16"
    predicted, limit = model.rollout(state, 20), NOTICED * max(trained.grid.spacing)
    assert torch.equal(predicted, rollout(round_network(trained), state, 20))
    torch.testing.assert_close(predicted, rollout(trained, state, 20), atol=limit, rtol=0)
    assert {p.name for p in (tmp_path / "zoo/drop/tiny").iterdir()} == {
        *("card.yaml", "config.yaml", "model.safetensors", "README.md", "rollout.png", "errors.csv", "chart.png"),
        *("scenes.csv", "training.csv"),
    }


METRICS = '[{"class_path": "nmpm.metrics.MSE"}, {"class_path": "nmpm.metrics.EarthMover", "init_args": {"every": 10}}]'


@pytest.mark.slow
def test_configurations_are_laid_over_one_another_and_refer_to_other_values(make_dataset):
    Path("mine.yaml").write_text("trainer: {default_root_dir: 'run_${model.frames}_${data.batch_size}'}\n")
    words = [*WATERDROP, "--config", "mine.yaml", *source("waterdrop.yaml", make_dataset)]
    assert main(["fit", *words, "--model.frames", "3", "--model.metrics", METRICS]) == 0
    report = json.loads(Path("run_3_2/report.json").read_text())
    assert report["test"]["emd"] > 0


def test_a_file_here_comes_before_the_shipped_one():
    assert find_config("goop.yaml").parent.name == "configs"
    Path("goop.yaml").write_text("seed_everything: 1\n")
    assert find_config("goop.yaml") == Path("goop.yaml")
    with pytest.raises(ConfigError, match=r"goop\.yaml"):
        find_config("../goop.yaml")


def test_help_of_training_names_all_that_can_be_set(capsys):
    with pytest.raises(SystemExit):
        main(["fit", "--config", "goop.yaml", "--help"])
    listed = set(re.findall(r"^  --((?:model|data)\.\w+)", capsys.readouterr().out, flags=re.M))
    names = {f"{section}.{key}" for section in ("model", "data") for key in known_options()[section]}
    assert listed == names - {"model.scene", "data.horizon"}


def test_help_all_lists_the_options_of_lightning_too(capsys):
    with pytest.raises(SystemExit):
        main(["fit", "--help_all"])
    assert "--trainer.max_steps" in capsys.readouterr().out


def test_a_diverged_run_stops_with_the_reason_and_keeps_the_last_good_checkpoint(make_dataset, capsys):
    data = [*source("waterdrop.yaml", make_dataset), "--trainer.default_root_dir", "run"]
    words = ["fit", *WATERDROP, *data, "--resume.every_n_train_steps", "1"]
    wild = ["--model.optimizer.lr", "1e30", "--trainer.max_steps", "50", "--model.schedule.warmup", "3"]
    assert main([*words, *wild, "--trainer.val_check_interval", "50", "--trainer.log_every_n_steps", "1"]) == 3
    said = capsys.readouterr().err
    assert "The training has diverged: at step" in said
    for path in Path("run/checkpoints").glob("*.ckpt"):
        saved = torch.load(path, weights_only=True)
        assert all(value.isfinite().all() for value in saved["state_dict"].values())
        assert str(path) in said


@pytest.mark.slow
def test_a_model_of_a_field_is_tested_on_data_without_it(make_dataset):
    words = ["--config", "heatedchannel.yaml", "--trainer.enable_progress_bar", "false", "--model.unroll", "1"]
    data = source("heatedchannel.yaml", make_dataset)
    tiny = ["--trainer.max_steps", "2", "--trainer.val_check_interval", "2", "--data.batch_size", "2"]
    assert main(["fit", *words, *tiny, *data]) == 0
    report = json.loads(Path("runs/heatedchannel/report.json").read_text())
    assert {"mse_temperature", "still/mse_temperature"} <= set(report["test"])
    with pytest.warns(UserWarning, match="The scene has no temperature"):
        assert main(["test", *words, *data, "--data.fields", "[]", "--ckpt_path", "best"]) == 0
    assert "mse_temperature" not in json.loads(Path("runs/heatedchannel/report.json").read_text())["test"]
    assert main(["predict", *words, *data, "--ckpt_path", "best"]) == 0
    predicted = Split(Path("runs/heatedchannel/predictions.h5"))
    assert predicted.fields(0)["temperature"].shape == (40, 11)
    model, test = "runs/heatedchannel", str(Path(data[1]) / "test.h5")
    assert main(["rollout", model, "--data", test, "--frames", "5", "--out", "out.h5"]) == 0
    assert Split(Path("out.h5")).fields(0)["temperature"].shape == (7, 11)
    assert Split(Path("out.h5")).read(0).position.shape == (7, 11, 2)
    publish.add(Path(model), "hot", root="zoo")
    entry = Zoo.load("hot", root="zoo")
    assert entry.predict(entry.example(count=4), 3).fields["temperature"].shape == (1, 3, 4)


def test_terminal_home_and_an_idle_slurm_job_end_no_training(make_dataset):
    """Nothing can be printed, the terminal knows ASCII alone, nobody is at home, and srun was not used."""
    words = ["fit", *WATERDROP, *source("waterdrop.yaml", make_dataset), "--trainer.default_root_dir=~/run"]
    words += ["--model.cells", "8", "--trainer.enable_progress_bar", "true"]
    environment = {name: value for name, value in os.environ.items() if name != "NMPM_HOME"}
    environment |= {"HOME": str(Path("home").absolute()), "LC_ALL": "C", "PYTHONIOENCODING": "ascii"}
    environment |= {"SLURM_JOB_ID": "1234", "SLURM_NTASKS": "4", "SLURM_JOB_NAME": "mine", "SLURM_PROCID": "0"}
    with open("/dev/full", "w") as full:
        run = subprocess.run(
            [sys.executable, "-m", "nmpm", *words], stdout=full, stderr=subprocess.PIPE, text=True, env=environment
        )
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr
    assert Path("home/run/report.json").is_file()
    assert Path("home/run/rollout.gif").is_file()
    assert not Path("~").exists()
    shown = subprocess.run(
        [sys.executable, "-m", "nmpm", "test", "~/run"], capture_output=True, text=True, env=environment
    )
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "free fall" in shown.stdout


def test_a_closed_pipe_ends_no_command_with_a_traceback():
    listed = subprocess.Popen(
        [sys.executable, "-m", "nmpm", "zoo", "list"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    listed.stdout.close()
    assert listed.stderr.read() == b""
    assert listed.wait() == 0


def test_paths_of_a_configuration_may_begin_with_the_home_folder(make_dataset, monkeypatch):
    monkeypatch.setenv("HOME", str(Path("home").absolute()))
    make_dataset(train=((40, 9),) * 2, valid=((40, 9),), test=((40, 9),)).rename(Path("home").absolute())
    Path("mine.yaml").write_text("trainer: {default_root_dir: ~/run}\ndata: {path: ~/}\n")
    built = []
    monkeypatch.setattr(EmulatorCLI, "_run_subcommand", lambda cli, _: built.append(cli))
    assert main(["fit", *WATERDROP, "--config", "mine.yaml"]) == 0
    assert built[0].run_folder.root == Path("home/run").absolute()
    assert not Path("~").exists()


def test_a_picture_that_cannot_be_drawn_is_a_warning(make_dataset, monkeypatch, capsys):
    def fail(*_):
        raise IndexError("index -9 is out of bounds")

    monkeypatch.setattr("nmpm.training.callbacks.outputs.write_snapshots", fail)
    words = [*WATERDROP, *source("waterdrop.yaml", make_dataset), "--trainer.default_root_dir", "run"]
    with pytest.warns(UserWarning, match=r"^rollout.png is not drawn: index -9 is out of bounds$"):
        assert main(["fit", *words, "--model.cells", "8"]) == 0
    assert "written to run: report.json, errors.csv, rollout.gif\n" in capsys.readouterr().out


def test_scenes_that_begin_empty_in_an_oblong_box_are_drawn(capsys):
    runs = [made_up_trajectory(40, 60, seed) for seed in range(2)]
    for run in runs:
        run.position[:10] = np.nan
        run.position[..., 0] *= 400
    for split in ("train", "valid", "test"):
        write_split(Path("late", f"{split}.h5"), runs)
    write_metadata(Path("late"), made_up_metadata(bounds=((0.0, 400.0), (0.0, 1.0)), particle_volume=0.5))
    words = [*WATERDROP, "--data.path", "late", "--trainer.default_root_dir", "run", "--model.cells", "[64, 8]"]
    assert main(["fit", *words]) == 0
    assert "written to run: report.json, errors.csv, rollout.png, rollout.gif\n" in capsys.readouterr().out


def test_too_little_data_is_refused_at_once_unless_the_length_of_the_training_is_stated(make_dataset, capsys):
    folder = make_dataset(train=((5, 10),), valid=((5, 10),), test=((5, 10),))
    for start in ([], ["--start_from", "goop"]):
        assert main(["fit", "--data.path", str(folder), *start]) == 1
        said = capsys.readouterr().err
        assert "5 frames of at most 10 particles to train on are 30 steps of particles" in said
        assert "--trainer.max_time 00:00:15:00 trains on these anyway" in said
    assert not Path("runs").exists()


PRINTING = {
    "fit": "fit --config waterdrop.yaml --data.path 'my data' --data.gravity '[0.0, -9.81]' --model.cells 8"
    f" --data.boundary '[wall, wall]' '--trainer.default_root_dir=my runs' {shlex.join(TINY)}",
    "init": "init 'my data' --out 'my data.yaml'",
    "convert": "convert 'my data' 'my copy'",
    "simulate": "simulate goop --frames 3 --train 0 --valid 0 --test 1 --out 'my goop'",
    "rollout": "rollout goop --frames 3 --particles 30 --out 'my rollout.h5'",
    "zoo match": "zoo match 'my data' --root zoo",
}
"""Commands that print further commands."""


@pytest.mark.parametrize("words", PRINTING.values(), ids=PRINTING)
def test_every_command_that_is_printed_runs(words, make_dataset, monkeypatch, capsys):
    sizes = ((40, 9),) * 2
    make_dataset(train=sizes, valid=sizes, test=sizes, gravity=None).rename("my data")
    shutil.copytree(shipped_folder("zoo") / "goop", Path("zoo", "goop"))
    sweep = "{scenes: 1, timing: {rounds: 1, frames: 4}, models: {precision: [float32], batch: [1]}}"
    monkeypatch.setattr("nmpm.evaluation.trade.shipped_sweep_text", lambda _: sweep)
    assert main(shlex.split(words)) == 0
    printed = printed_commands(capsys.readouterr().out)
    assert printed
    while printed:
        command = ["mine" if word == "NAME" else word for word in printed.pop(0)]
        if command[1:3] == ["zoo", "add"]:
            command += ["--about", "Made up."]
        tiny = TINY if command[1] == "fit" else []
        assert main([*command[1:], *tiny]) == 0, command
        printed += printed_commands(capsys.readouterr().out) if command[1] == "trade" else []


def printed_commands(text: str) -> list[list[str]]:
    """Commands at the end of a line, or before two spaces or a comma."""
    lines = re.findall(r"(?:^ +|: +)(nmpm (?:[^\n, ]|,(?! )| (?! ))+)", text, re.MULTILINE)
    return [shlex.split(line) for line in lines]
