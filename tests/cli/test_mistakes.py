"""Mistakes get a message of one line that names what is wrong and how to mend it, most before torch is imported."""

import errno
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from nmpm import EmulatorModule
from nmpm._support.shipped import user_home
from nmpm.cli import COMMANDS, expand_home, main
from nmpm.cli.measure import GROUP_NAMES
from nmpm.cli.options import RUNTIMES
from nmpm.cli.training import OPTIONS_FILE, forget_unused_slurm
from nmpm.emulator import runtimes
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.stress import GROUPS
from nmpm.training.checkpoints import AtomicCheckpointIO
from nmpm.training.preflight import check_disk
from tests.scenes import box
from tests.trainings import TINY, trainer_of

GOOP = ["fit", "--config", "goop.yaml"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def complain(words: list[str], status: int, capsys) -> str:
    assert main(words) == status
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("nmpm")
    assert said.err.count("\n") == 1
    assert len(said.err) < 600
    return said.err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--model.constraints.enrgy", "true"], "did you mean --model.constraints.energy?"),
        (["--model.optimizer", "torch.optim.Adm"], "--model.optimizer: there is no torch.optim.Adm; did you mean"),
        (["--model.processor.widht", "3"], "the argument widht is unknown; did you mean width?"),
        (["--trainer.max_steps", "abc"], "--trainer.max_steps: abc is not of type int"),
        (["--data.source", "foo"], "--data.source: foo is not one of 'disk', 'simulate', 'hub'"),
        (["--model.processor", "nmpm.transfer.Linear"], "--model.processor: Import path nmpm.transfer.Linear does not"),
    ],
    ids=lambda value: "",
)
def test_a_wrong_option_gets_the_nearest_name(words, complaint, capsys):
    assert complaint in complain([*GOOP, *words], 2, capsys)


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("model: {widht: 3}", "unknown key model.widht; did you mean model.processor.width?"),
        ("modle: {cells: 3}", "unknown key modle.cells; did you mean model.cells?"),
        ("model: {cells: 3\n  a: [", "--config mine.yaml cannot be read: while parsing a flow mapping"),
        (BOMB, "--config mine.yaml cannot be read: line 10: nested more than 32 deep, or aliases repeat"),
        ("data: {path: '${oc.${data.name}:HOME}'}", ": ${…} refers to other keys"),
        ("trainer: inner.yaml", "--trainer: Unable to load config 'inner.yaml' - line 10: nested"),
    ],
    ids=lambda value: "",
)
def test_a_wrong_configuration(text, complaint, capsys):
    Path("mine.yaml").write_text(text)
    Path("inner.yaml").write_text(BOMB)
    assert complaint in complain(["fit", "--config", "mine.yaml"], 2, capsys)


LONG = "x" * 300


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["fit", "--config", "gop.yaml"], "Did you mean goop.yaml"),
        ([*GOOP, "--model.optimizer.lr", "-1"], "lr = -1.0 must be a positive number"),
        ([*GOOP, "--trainer.max_steps", "-1", "--trainer.max_time", "null"], "has no end"),
        ([*GOOP, "--checkpoint.dirpath", __file__], "it is a file"),
        ([*GOOP, "--trainer.default_root_dir", LONG], "ame (is )?too long"),
        ([*GOOP, "--model.cells", "4"], "too small for a U-Net of depth 3"),
        (
            ["test", *GOOP[1:], "--ckpt_path", "best"],
            "there is no .*best.ckpt; checkpoints there: none. To start a new",
        ),
        (["validate", *GOOP[1:]], "--ckpt_path is missing, so the model would be an untrained one: give best or last"),
        (["rollout", "goop", "--frames", "0"], "--frames 0: it must be at least 1."),
        (["rollout", "goop", "--gravity", "down"], "--gravity down"),
        (["rollout", "goop", "--gravity", "0,-5"], r"but the model knows only \[0.0, -9.81\]"),
        (["rollout", "wbcsph", "--gravity", "0,-50"], "outside of the range that the model was calibrated"),
        (["rollout", "goop", "--data", "nowhere.h5"], "--data nowhere.h5: there is no such file or folder."),
        (["rollout", "goop", "--data", "."], "no known format"),
        (["rollout", "goop", "--out", "file/a.h5"], "--out file/a.h5: file is a file, not a folder."),
        (["rollout", "goop", "--device", "cuda:77"], "has no device 'cuda:77'"),
        (["rollout", "goop", "--device", "meta"], "--device meta: it is not one of"),
        (["rollout", "goop", "--runtime", "fast"], "called 'fast'; there are auto, "),
        (["rollout", "gop"], r"Did you mean goop\?"),
        (["rollout", "nothing.ckpt"], "nothing.ckpt: there is no such checkpoint"),
        (["simulate", "waterramp", "--out", "a"], "Did you mean waterramps"),
        (["simulate", "goop", "--preview", "a.gif"], "--preview a.gif: pictures are PNG"),
        (["simulate", "goop", "--out", "file"], "--out file: it is a file; name a folder."),
        (["inspect", "nowhere"], "nowhere: there is no such file or folder."),
        (["render", "nowhere.h5"], "FILE nowhere.h5: there is no such file."),
        (["export", "goop", "--out", "no/a.onnx"], "--out no/a.onnx: the folder no does not exist"),
        (["stress", "goop", "--groups", "speed"], "--groups speed: the groups are long, settling, speeds"),
        (["trade"], "name a dataset"),
        (["trade", "sandramp"], "Did you mean sandramps"),
        (["compare", "goop", "--data", "goop", "--wider", "1"], "--wider 1: it must be at least 2"),
        (["compare", "goop", "--data", "nothing", "--wider", "2"], "--data nothing: there is no such file or folder"),
        (["compare", "goop", "--data", ".", "--wider", "2"], ". cannot be widened"),
        (["zoo", "card", "../goop"], "holds no model '../goop'"),
        (["zoo", "list", "--root", "nowhere"], "There is no zoo in nowhere"),
        (["zoo", "verify", "--data", "."], "--data is the folder of one model's data: give the model's NAME too"),
    ],
    ids=lambda value: "",
)
def test_a_mistake_is_found_before_the_work(words, complaint, folder, capsys):
    (folder / "file").touch()
    assert re.search(complaint, complain(words, 1, capsys))
    assert [path.name for path in folder.iterdir()] == ["file"]


@pytest.mark.parametrize("words", [["rollout", "goop", "--out", "a.h5"], ["simulate", "goop", "--out", "new"]])
def test_a_read_only_folder_is_found_before_the_work(words, monkeypatch, capsys):
    def fail(**_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(tempfile, "TemporaryFile", fail)
    assert main(words) == 1
    assert "is not writable (Read-only file system)" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["demo", "simulate", "fit"])
def test_an_interruption_is_one_line_without_an_empty_one(command, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(COMMANDS[command], "_simulate" if command == "simulate" else "run_words", interrupt)
    assert main([command, "goop"]) == 130
    assert re.fullmatch(rf"nmpm {command}: interrupted[.;].*\n", capsys.readouterr().err)


def test_wrong_commands(capsys):
    assert "did you mean fit?" in complain(["fti"], 2, capsys)
    assert main([]) == 2


EARLY = [
    (["--model.cels=3"], "did you mean --model.cells?"),
    (["--config", "mine.yaml"], "unknown key model.cels; did you mean model.cells?"),
    (["--model.processor=nmpm.processors.Unet"], "did you mean nmpm.processors.UNet?"),
    (["--model.frames", "abc"], "--model.frames: abc is not of type int"),
    (["--model.nothing", "3"], "there is no option --model.nothing. See nmpm fit --help"),
    (["--model.widht", "3"], "did you mean --model.processor.width?"),
    (["--trainer.max_steps", "abc"], "--trainer.max_steps: abc is not of type int"),
    (["--trainer.max_stpes", "3"], "did you mean --trainer.max_steps?"),
    (["--trainer.default_root_dir", "mine.yaml"], "--trainer.default_root_dir mine.yaml: it is a file"),
    (["--data.source", "foo"], "--data.source: foo is not one of 'disk', 'simulate', 'hub'"),
    (["--confg", "mine.yaml"], "there is no option --confg; did you mean --config?"),
    (["--threads", "many"], "--threads: many is not of type int"),
    (["fit"], "there are no data: give --data.path FOLDER"),
    (["--data.path", "nowhere"], "--data.path nowhere: there is no such dataset."),
    (["--data.name", "lava"], "No embedded dataset is called 'lava'"),
    (["--start_from", "nowhere"], "The zoo holds no model 'nowhere'"),
    (["--ckpt_path=nowhere.ckpt"], "--ckpt_path nowhere.ckpt: there is no such checkpoint."),
    (["test", "nowhere"], "nmpm test: nowhere: there is no such folder."),
    (["predict", "mine.yaml"], "mine.yaml is a file: name the folder of a run"),
    (["validate", "."], ". is not the folder of a run: there is no config.yaml in it."),
    (["test", "run"], "no run/checkpoints/best.ckpt or run/checkpoints/last.ckpt; checkpoints there: none."),
    (["fit", "--resume=run"], "run: there is no run/checkpoints/last.ckpt; checkpoints there: none."),
    (["fit", "--resume"], "--resume lacks the folder of a run"),
    (["fit", "run"], "to go on with a run, call nmpm fit --resume run."),
    (["rollout", "nowhere"], "The zoo holds no model 'nowhere'"),
    (["rollout", "gop", "--device", "cuda"], "Did you mean goop?"),
    (["rollout", "goop", "--root", "nowhere"], "There is no zoo in nowhere"),
    (["rollout", "goop", "--device", "abacus"], "--device abacus: it is not one of auto, cpu, cuda, mps."),
    (["rollout", "goop", "--device", "cuda:first"], "--device cuda:first: it is not one of"),
    (["rollout", "goop", "--data", "nowhere"], "--data nowhere: there is no such file or folder"),
    (
        ["rollout", "goop", "--runtime", "fast"],
        "No runtime is called 'fast'; there are auto, openvino",
    ),
    (["stress", "goop", "--groups", "speed"], "--groups speed: the groups are long, settling, speeds"),
    (["stress", "goop", "--runtime", "fast"], "No runtime is called 'fast'"),
    (["demo", "waterdrop"], "waterdrop was not trained on scenes of a shipped simulator"),
    (["demo", "nowhere"], "The zoo holds no model 'nowhere'"),
    (["trade", "nowhere"], "DATASET nowhere: there is no such file or folder"),
    (["trade", "goop", "--models", "goop", "nowhere"], "The zoo holds no model 'nowhere'"),
    (["compare", "nowhere", "--data", "goop"], "The zoo holds no model 'nowhere'"),
    (["compare", "goop", "--data", "nowhere"], "--data nowhere: there is no such file or folder"),
    (["export", "nowhere"], "The zoo holds no model 'nowhere'"),
    (["stress", "nowhere"], "The zoo holds no model 'nowhere'"),
    (["stress", "goop", "--preset", "lava"], "There is no preset or file lava"),
    (["stress", "goop", "--device", "abacus"], "--device abacus: it is not one of"),
    (["zoo", "card", "nowhere"], "The zoo holds no model 'nowhere'"),
    (["zoo", "verify", "nowhere"], "The zoo holds no model 'nowhere'"),
    (["zoo", "refresh", "nowhere", "--root", "run"], "The zoo holds no model 'nowhere'"),
    (["zoo", "refresh", "--root", "run", "--device", "abacus"], "--device abacus: it is not one of"),
    (["zoo", "push", "nowhere", "me/goop"], "The zoo holds no model 'nowhere'"),
    (["zoo", "match", "nowhere"], "DATA nowhere: there is no such file or folder"),
    (["simulate", "lava"], "There is no preset or file lava"),
    (["init", "nowhere"], "PATH nowhere: there is no such file or folder"),
]
"""Words of a command, or of `nmpm fit` with goop's configuration; and what is said."""
SCRIPT = """
import sys, json
from nmpm.cli import main
for words in json.loads(sys.argv[1]):
    assert main(words)
print("imported", sorted({"torch", "lightning", "numba"} & set(sys.modules)))
"""


def test_common_mistakes_are_found_before_torch_and_lightning_are_imported(folder):

    (folder / "mine.yaml").write_text("model: {cels: 3}\n")
    (folder / "run").mkdir()
    (folder / "run" / "config.yaml").write_text("model: {cells: 3}\n")
    calls = [words if words[0] in COMMANDS else [*GOOP, *words] for words, _ in EARLY]
    done = subprocess.run([sys.executable, "-c", SCRIPT, json.dumps(calls)], capture_output=True, text=True)
    assert done.stdout == "imported []\n", done.stderr
    said = done.stderr.splitlines()
    assert len(said) == len(EARLY)
    for line, (_, complaint) in zip(said, EARLY, strict=True):
        assert complaint in line


@pytest.mark.parametrize(
    ("words", "unwanted"),
    [
        (["rollout", "goop", "--frames", "8", "--out", "out.h5"], {"lightning", "neuralop", "matplotlib"}),
        (["simulate", "--list"], {"lightning", "torch", "matplotlib"}),
        (["zoo", "card", "goop"], {"lightning", "matplotlib"}),
        (["zoo", "list"], {"lightning", "torch", "matplotlib"}),
        (["fit", "--help"], {"lightning", "torch", "numpy"}),
        (["rollout", "--help"], {"torch", "numpy", "h5py"}),
        (["inspect", "--help"], {"torch", "numpy", "h5py"}),
        (["--help"], {"lightning", "torch", "numpy"}),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_command_imports_what_it_needs(words, unwanted):
    script = "import sys; from contextlib import suppress; from nmpm.cli import main\n"
    script += f"with suppress(SystemExit): assert main({words!r}) == 0\n"
    script += f"print('imported', sorted({unwanted!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.splitlines()[-1] == "imported []"


USAGES = [
    (["demo", "goop", "--frames", "abc"], "--frames: abc is not of type int"),
    (["stress", "goop", "--nothing"], "there is no option --nothing"),
    (["rollout", "goop", "--watch", "no"], "argument --watch: invalid choice: 'no'"),
    (["zoo", "crad", "goop"], "there is no command 'crad'; did you mean card?"),
    (["zoo", "card"], "the following arguments are required: name"),
    *(([command, "--no-such-option"], "") for command in COMMANDS),
]


@pytest.mark.parametrize(("words", "complaint"), USAGES, ids=lambda value: "")
def test_a_wrong_call_is_one_line_that_names_the_help(words, complaint, capsys):
    assert main(words) in (1, 2)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert complaint in said
    assert "--help" in said


def test_names_that_commands_have_without_torch_are_those_that_there_are():
    assert tuple(GROUPS) == GROUP_NAMES
    assert set(RUNTIMES) == {"auto", *runtimes.RUNTIMES}


def test_simulators_and_numba_are_imported_for_simulated_data_alone():
    script = "import sys; import nmpm.cli.run_training; print(sorted({'numba', 'nmpm.sim'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_the_stored_options_of_trainings_are_those_of_the_classes():
    # A process of its own: options accept every subclass that is imported, and tests define some.
    file = str(Path(__file__).parents[2] / "benchmarks" / "training_options.py")
    script = f"import json, runpy; print(json.dumps(runpy.run_path({file!r})['training_options']()))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    stored = json.loads(OPTIONS_FILE.read_text(encoding="utf-8"))
    assert stored == json.loads(done.stdout), "python benchmarks/training_options.py writes them anew"


def test_without_a_home_folder_files_are_kept_with_the_temporary_ones(monkeypatch):
    def fail(path):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("NMPM_HOME", raising=False)
    monkeypatch.setattr(Path, "expanduser", fail)
    assert user_home() == Path(tempfile.gettempdir()) / f"nmpm-{os.getuid()}"


@pytest.mark.parametrize(
    ("word", "read"),
    [
        ("~/a", "/home/me/a"), ("--out=~/a", "/home/me/a"), ("--data.path=~", "/home/me"), ("a~", "a~"),
        ("--about=see ~/a", None), ("~5 cells", "~5 cells"), ("runs/~", "runs/~"),
    ],
)  # fmt: skip
def test_the_home_folder_is_known_at_the_beginning_of_a_path(word, read, monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    option = f"{word.partition('=')[0]}=" if word.startswith("--") else ""
    assert expand_home(word) == (word if read is None else option + read)


@pytest.mark.parametrize(
    ("names", "kept"), [(["SLURM_STEP_ID"], True), ([], False), (["SLURM_STEP_ID", "SLURM_PTY_PORT"], False)]
)
def test_slurm_counts_where_srun_has_started_the_process(names, kept, monkeypatch):
    for name in ("SLURM_STEP_ID", "SLURM_STEPID", "SLURM_PTY_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name in ("SLURM_NTASKS", *names):
        monkeypatch.setenv(name, "2")
    forget_unused_slurm()
    assert ("SLURM_NTASKS" in os.environ) == kept


def test_a_quota_is_found_before_the_training(monkeypatch, tmp_path):
    def refuse(*_):
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    trainer = trainer_of(tmp_path, 2)
    module = EmulatorModule(box(), cells=8, processor=TINY)
    check_disk(trainer, module)
    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(ConfigError, match="your quota there, or the disk"):
        check_disk(trainer, module)


def test_a_checkpoint_that_a_full_disk_cuts_is_one_line_and_keeps_the_former_one(tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint({"state_dict": {}}, path)
    before = path.read_bytes()

    def fail(*_):
        raise RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 64 vs 0")

    monkeypatch.setattr("nmpm.training.checkpoints.torch.save", fail)
    with pytest.raises(DataError, match=r"last\.ckpt cannot be written: the disk, or your quota, is full"):
        AtomicCheckpointIO().save_checkpoint({"state_dict": {}}, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
