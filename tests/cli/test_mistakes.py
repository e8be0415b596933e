"""Mistakes get a message of one line that names what is wrong and how to mend it, most before torch is imported."""

import errno
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from nmpm import EmulatorModule
from nmpm._support.shipped import user_home
from nmpm.cli import COMMANDS, expand_home, main
from nmpm.cli.training_options import OPTIONS_FILE, forget_unused_slurm
from nmpm.errors import ConfigError, DataError
from nmpm.training.checkpoints import AtomicCheckpointIO
from nmpm.training.preflight import check_disk
from tests.scenes import box
from tests.trainings import TINY, trainer_of

GOOP = "fit --config goop.yaml"
BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))
FILES = {
    "file": "", "run/config.yaml": "model: {cells: 3}\n", "cels.yaml": "model: {cels: 3}\n", "bomb.yaml": BOMB,
    "modle.yaml": "modle: {cells: 3}", "widht.yaml": "model: {widht: 3}", "flow.yaml": "model: {cells: 3\n  a: [",
    "hidden.yaml": "data: {path: '${oc.${data.name}:HOME}'}", "outer.yaml": "trainer: bomb.yaml",
}  # fmt: skip
EARLY = [
    *((2, f"{GOOP} {words}", complaint) for words, complaint in (
        ("--model.cels=3", "did you mean --model.cells?"),
        ("--config cels.yaml", "unknown key model.cels; did you mean model.cells?"),
        ("--config widht.yaml", "unknown key model.widht; did you mean model.processor.width?"),
        ("--config flow.yaml", "--config flow.yaml cannot be read: while parsing a flow mapping"),
        ("--config bomb.yaml", "--config bomb.yaml cannot be read: line 10: nested more than 32 deep, or aliases"),
        ("--model.processor=nmpm.processors.Unet", "did you mean nmpm.processors.UNet?"),
        ("--model.frames abc", "--model.frames: abc is not of type int"),
        ("--model.nothing 3", "there is no option --model.nothing. See nmpm fit --help"),
        ("--model.widht 3", "did you mean --model.processor.width?"),
        ("--trainer.max_steps abc", "--trainer.max_steps: abc is not of type int"),
        ("--trainer.max_stpes 3", "did you mean --trainer.max_steps?"),
        ("--data.source foo", "--data.source: foo is not one of 'disk', 'simulate', 'hub'"),
        ("--confg cels.yaml", "there is no option --confg; did you mean --config?"),
        ("--threads many", "--threads: many is not of type int"),
    )),
    *((1, f"{GOOP} {words}", complaint) for words, complaint in (
        ("--trainer.default_root_dir file", "--trainer.default_root_dir file: it is a file"),
        ("--data.path nowhere", "--data.path nowhere: there is no such dataset."),
        ("--data.name lava", "No embedded dataset is called 'lava'"),
        ("--start_from nowhere", "The zoo holds no model 'nowhere'"),
        ("--ckpt_path=nowhere.ckpt", "--ckpt_path nowhere.ckpt: there is no such checkpoint."),
        (f"--trainer.default_root_dir {300 * 'x'}", "too long"),
    )),
    (2, "fti", "did you mean fit?"),
    (1, "fit", "there are no data: give --data.path FOLDER"),
    (1, "fit --config gop.yaml", "Did you mean goop.yaml"),
    (1, "fit --start_from goop --data.path . --materials a=b=c", "--materials a=b=c: give"),
    (1, "fit --data.path . --stride 2", "--stride is of --start_from MODEL"),
    (1, "test nowhere", "nmpm test: nowhere: there is no such folder."),
    (1, "predict file", "file is a file: name the folder of a run"),
    (1, "validate .", ". is not the folder of a run: there is no config.yaml in it."),
    (1, "test run", "no run/checkpoints/best.ckpt or run/checkpoints/last.ckpt; checkpoints there: none."),
    (1, "fit --resume=run", "run: there is no run/checkpoints/last.ckpt; checkpoints there: none."),
    (2, "fit --resume", "--resume lacks the folder of a run"),
    (2, "fit run", "to go on with a run, call nmpm fit --resume run."),
    (1, "rollout nowhere", "The zoo holds no model 'nowhere'"),
    (1, "rollout gop --device cuda", "Did you mean goop?"),
    (1, "rollout goop --root nowhere", "There is no zoo in nowhere"),
    (1, "rollout goop --frames 0", "--frames 0: it must be at least 1."),
    (1, "rollout goop --gravity down", "--gravity down"),
    (1, "rollout goop --device abacus", "--device abacus: it is not one of auto, cpu, cuda, mps."),
    (1, "rollout goop --device cuda:first", "--device cuda:first: it is not one of"),
    (1, "rollout goop --device meta", "--device meta: it is not one of"),
    (1, "rollout goop --data nowhere", "--data nowhere: there is no such file or folder"),
    (1, "rollout goop --data . --stride 2/3", "--stride 2/3: give a whole number"),
    (1, "rollout goop --data . --materials big", "--materials big: give DATA=MODEL pairs"),
    (1, "rollout goop --materials big=sand", "--materials, --stride and --strict are about recorded data"),
    (1, "rollout goop --out file/a.h5", "--out file/a.h5: file is a file, not a folder."),
    (1, "rollout goop --runtime fast", "No runtime is called 'fast'; there are auto, openvino"),
    (2, "rollout goop --watch no", "argument --watch: invalid choice: 'no'"),
    (1, "stress nowhere", "The zoo holds no model 'nowhere'"),
    (1, "stress goop --groups speed", "--groups speed: the groups are long, settling, speeds"),
    (1, "stress goop --runtime fast", "No runtime is called 'fast'"),
    (1, "stress goop --preset lava", "There is no preset or file lava"),
    (1, "stress goop --device abacus", "--device abacus: it is not one of"),
    (1, "stress goop --stride 2", "--stride and --strict are about the scenes of a --preset"),
    (2, "stress goop --nothing", "there is no option --nothing"),
    (1, "demo waterdrop", "waterdrop was not trained on scenes of a shipped simulator"),
    (1, "demo nowhere", "The zoo holds no model 'nowhere'"),
    (2, "demo goop --frames abc", "--frames: abc is not of type int"),
    (1, "trade", "name a dataset"),
    (1, "trade nowhere", "DATASET nowhere: there is no such file or folder"),
    (1, "trade sandramp", "Did you mean sandramps"),
    (1, "trade goop --models goop nowhere", "The zoo holds no model 'nowhere'"),
    (1, "trade goop --members 0", "--members 0: it must be at least 1"),
    (1, "compare nowhere --data goop", "The zoo holds no model 'nowhere'"),
    (1, "compare goop --data nowhere --wider 2", "--data nowhere: there is no such file or folder"),
    (1, "compare goop --data goop --wider 1", "--wider 1: it must be at least 2"),
    (1, "compare goop --data . --stride 0", "--stride 0: give a whole number"),
    (1, "export nowhere", "The zoo holds no model 'nowhere'"),
    (1, "export goop --out no/a.onnx", "--out no/a.onnx: the folder no does not exist"),
    (1, "render nowhere.h5", "FILE nowhere.h5: there is no such file"),
    (1, "zoo list --root nowhere", "There is no zoo in nowhere"),
    (1, "zoo card ../goop", "holds no model '../goop'"),
    (2, "zoo crad goop", "there is no command 'crad'; did you mean card?"),
    (2, "zoo card", "the following arguments are required: name"),
    (1, "zoo verify nowhere", "The zoo holds no model 'nowhere'"),
    (1, "zoo verify --data .", "--data is the folder of one model's data: give the model's NAME too"),
    (1, "zoo refresh nowhere --root run", "The zoo holds no model 'nowhere'"),
    (1, "zoo refresh --root run --device abacus", "--device abacus: it is not one of"),
    (1, "zoo push nowhere me/goop", "The zoo holds no model 'nowhere'"),
    (1, "zoo match nowhere", "DATA nowhere: there is no such file or folder"),
    (1, "zoo match . --stride 1/0", "--stride"),
    (1, "simulate lava", "There is no preset or file lava"),
    (1, "simulate waterramp --out a", "Did you mean waterramps"),
    (1, "simulate goop --preview a.gif", "--preview a.gif: pictures are PNG"),
    (1, "simulate goop --out file", "--out file: it is a file; name a folder."),
    (1, "inspect nowhere", "nowhere: there is no such file or folder."),
    (1, "init nowhere", "PATH nowhere: there is no such file or folder"),
    (1, "init run --out file", "file exists already"),
    (1, "init run --dt 0.1", "--dt: a configuration cannot state it; write it into a copy of the data"),
    (1, "init run --minutes 0", "--minutes 0: it must be positive."),
    (1, "convert run a.xyz", "DESTINATION a.xyz: nothing is written by that suffix; there are .h5, .vtkhdf, "),
    (1, "convert run a --trajectory 0", "--trajectory and --split are for a DESTINATION that is a file."),
    *(
        (1, f"convert run a {fact}", re.split("=+", fact)[-1].strip("-"))
        for fact in ("--types water", "--static=a", "--bounds=1:0,0:1", "--gravity=down", "--family=deepmin", "--dt=-1")
    ),
    *((2, f"{command} --no-such-option", "--help") for command in COMMANDS),
    *((1, f"play {words}", words) for words in (
        ("--port 99999", "--out played.csv", "--seed -1", "nosuch") if find_spec("websockets") else ()
    )),
]  # fmt: skip
"""Mistakes that are found before torch is imported: exit status, words, and what is said."""
LATE = [
    (2, f"{GOOP} --model.constraints.enrgy true", "did you mean --model.constraints.energy?"),
    (2, f"{GOOP} --model.optimizer torch.optim.Adm", "--model.optimizer: there is no torch.optim.Adm; did you mean"),
    (2, f"{GOOP} --model.processor.widht 3", "the argument widht is unknown; did you mean width?"),
    (2, f"{GOOP} --model.processor nmpm.transfer.Linear", "--model.processor: Import path nmpm.transfer.Linear"),
    (2, f"{GOOP} --config modle.yaml", "unknown key modle.cells; did you mean model.cells?"),
    (2, f"{GOOP} --config hidden.yaml", ": ${…} refers to other keys"),
    (2, f"{GOOP} --config outer.yaml", "--trainer: Unable to load config 'bomb.yaml' - line 10: nested"),
    (1, f"{GOOP} --model.optimizer.lr -1", "lr = -1.0 must be a positive number"),
    (1, f"{GOOP} --trainer.max_steps -1 --trainer.max_time null", "has no end"),
    (1, f"{GOOP} --checkpoint.dirpath file", "it is a file"),
    (1, f"{GOOP} --model.cells 4", "too small for a U-Net of depth 3"),
    (1, "test --config goop.yaml --ckpt_path best", "best.ckpt; checkpoints there: none. To start a new"),
    (1, "validate --config goop.yaml", "--ckpt_path is missing, so the model would be an untrained one: give best"),
    (1, "rollout nothing.ckpt", "nothing.ckpt: there is no such checkpoint"),
    (1, "rollout goop --gravity 0,-5", "but the model knows only [0.0, -9.81]"),
    (1, "rollout wbcsph --gravity 0,-50", "outside of the range that the model was calibrated"),
    (1, "rollout goop --data .", "no known format"),
    (1, "rollout goop --device cuda:77", "has no device 'cuda:77'"),
    (1, "compare goop --data . --wider 2", ". cannot be widened"),
]  # fmt: skip
"""As `EARLY`, with torch."""
ALL = """
import contextlib, io, json, sys
from nmpm.cli import main
said = []
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as error:
        said.append([main(words), out.getvalue(), error.getvalue()])
print(json.dumps([said, sorted({"torch", "lightning", "numba"} & set(sys.modules))]))
"""


@pytest.fixture
def contents(folder):
    """What the folder has, also after the mistakes."""
    for name, text in FILES.items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    yield
    assert {str(path.relative_to(folder)) for path in folder.rglob("*")} == {*FILES, "run"}


def check(words: str, status: int, complaint: str, ended: tuple[int, str, str]) -> None:
    """One line is said, on standard error, and names what is wrong."""
    assert ended[:2] == (status, ""), words
    assert complaint in ended[2], words
    assert ended[2].startswith("nmpm")
    assert ended[2].count("\n") == 1
    assert len(ended[2]) < 600


@pytest.mark.usefixtures("contents")
def test_most_mistakes_are_found_before_torch_and_lightning_are_imported():
    calls = json.dumps([shlex.split(words) for _, words, _ in EARLY])
    done = subprocess.run([sys.executable, "-c", ALL, calls], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said, imported = json.loads(done.stdout)
    for (status, words, complaint), ended in zip(EARLY, said, strict=True):
        check(words, status, complaint, tuple(ended))
    assert imported == []


@pytest.mark.usefixtures("contents")
@pytest.mark.parametrize(("status", "words", "complaint"), LATE, ids=[words for _, words, _ in LATE])
def test_the_other_mistakes_are_found_before_the_work(status, words, complaint, capsys):
    ended = main(shlex.split(words))
    check(words, status, complaint, (ended, *capsys.readouterr()))


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


def test_without_a_command_there_is_the_general_help(capsys):
    assert main([]) == 2
    assert "usage: nmpm COMMAND" in capsys.readouterr().out


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
