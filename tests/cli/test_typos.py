from pathlib import Path

import pytest

from nmpm.cli import main

MISTAKES = [
    (["--model.cels", "32"], "no option --model.cels; did you mean --model.cells?"),
    (["--data.nme", "goop"], "no option --data.nme; did you mean --data.name?"),
    (["--model.constraints.enrgy", "true"], "did you mean --model.constraints.energy?"),
    (
        ["--model.processor", "nmpm.processors.Unet"],
        "--model.processor: there is no nmpm.processors.Unet; did you mean",
    ),
    (["--model.optimizer", "torch.optim.Adm"], "--model.optimizer: there is no torch.optim.Adm; did you mean"),
    (["--model.processor.widht", "3"], "the argument widht is unknown; did you mean width?"),
    (["--trainer.max_steps", "abc"], "--trainer.max_steps: abc is not of type int"),
    (["--data.source", "foo"], "--data.source: foo is not one of 'disk', 'simulate', 'hub'"),
    (["--model.processor", "nmpm.transfer.Linear"], "--model.processor: Import path nmpm.transfer.Linear does not"),
]


@pytest.mark.parametrize(("words", "complaint"), MISTAKES, ids=lambda value: "")
def test_a_wrong_option_gets_one_line_with_the_nearest_name(words, complaint, capsys):
    assert main(["fit", "--config", "goop.yaml", *words]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert complaint in said.err
    assert said.err.startswith("nmpm fit: ")
    assert said.err.count("\n") == 1
    assert len(said.err) < 350


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))
FILES = [
    ("model: {widht: 3}", "unknown key model.widht; did you mean model.processor.width?"),
    ("modle: {cells: 3}", "unknown key modle.cells; did you mean model.cells?"),
    ("model: {processor: {class_path: nmpm.processors.UNet, init_args: {widht: 3}}}", "did you mean"),
    ("model: {cells: 3\n  a: [", "--config mine.yaml cannot be read: while parsing a flow mapping"),
    ("model: " + "[" * 20_000, "--config mine.yaml cannot be read: line 1: nested more than 32 deep"),
    (BOMB, "--config mine.yaml cannot be read: line 10: nested more than 32 deep, or aliases"),
    ("model: {cells: '\udce9'}", "--config mine.yaml cannot be read: 'utf-8' codec"),
    ("data: {path: '${oc.env:HOME}'}", "${oc.env:HOME}: ${…} refers to other keys"),
    ("data: {path: '${oc.${data.name}:HOME}'}", ": ${…} refers to other keys"),
    ("trainer: inner.yaml", "--trainer: Unable to load config 'inner.yaml' - line 10: nested"),
]


@pytest.mark.parametrize(("text", "complaint"), FILES, ids=range(len(FILES)))
def test_a_wrong_key_in_a_file_too(text, complaint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(text, encoding="utf-8", errors="surrogateescape")
    Path("inner.yaml").write_text(BOMB)
    assert main(["fit", "--config", "mine.yaml"]) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1


def test_a_wrong_command_gets_the_nearest_one(capsys):
    assert main(["fti"]) == 2
    assert "did you mean fit?" in capsys.readouterr().err
