"""Help of the training commands on one screen or two, read from the source: importing Lightning takes seconds.

`--help_all` lists every option with type and default, also those of Lightning's Trainer, and takes those seconds.
"""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Iterator

from nmpm.cli.early_checks import SIGNATURES, argument_names, class_definition

LINKED = {"model": {"scene", "recipe"}, "data": {"horizon"}}
"""Arguments that the command line takes from elsewhere."""
INDENT, WIDTH = 30, 100

_TEXT = """\
usage: nmpm {command} --config FILE [--SECTION.KEY VALUE ...]
       nmpm {command} {run} [--SECTION.KEY VALUE ...]

{summary}
RUN is the folder of a run, which holds its configuration; it may have been moved or copied.
Options replace what the configuration says, and later --config files what earlier ones say. What
none of them says has the default that --help_all shows.

examples:
{examples}

options:
{options}

--model.KEY:
{model}

--data.KEY:
{data}

--trainer.KEY, of Lightning's Trainer, such as:
{trainer}

--checkpoint.KEY and --resume.KEY are of Lightning's ModelCheckpoint: which checkpoint is the best,
and how often the one to resume from is written.

more:
  nmpm {command} --help_all                  every option with type and default; takes seconds
  nmpm {command} --config goop.yaml --print_config
      the whole configuration
  nmpm {command} --model.processor.help nmpm.processors.UNet
      options of a part
"""
_EXAMPLES = {
    "fit": """\
  nmpm fit --config goop.yaml                           simulate data, train, test, draw
  nmpm fit --resume runs/goop                           go on after an interruption
  nmpm fit --config goop.yaml --trainer.max_time 00:00:05 --trainer.default_root_dir runs/short
  nmpm fit --config waterdrop.yaml --data.path FOLDER   train on recorded data""",
    "validate": """\
  nmpm validate runs/goop                               its best weights""",
    "test": """\
  nmpm test runs/goop                                   its best weights
  nmpm test runs/goop --ckpt_path last                  its last ones
  nmpm test runs/goop --data.path FOLDER                on other scenes""",
    "predict": """\
  nmpm predict runs/goop                                its best weights""",
}
_OPTIONS = {
    "--config FILE": "YAML; a name that is no file here is looked up among the shipped ones (nmpm --help lists them)",
    "--ckpt_path last|best|FILE": "a checkpoint of the run, or a file: fit goes on from it, the other commands run it",
    "--start_from MODEL": "fit only: start with the weights of a zoo model, a run or a checkpoint of the same parts",
    "--seed_everything N": "seed of all random numbers (default: 0)",
    "--print_config": "print the configuration that results, and stop",
}
_TRAINER = {
    "default_root_dir": "folder of the run's files",
    "max_steps, max_time": "end of the training: steps, or DD:HH:MM:SS, whichever is first",
    "accelerator, devices": "where to compute: auto, cpu, gpu; how many devices, see docs/scaling.md",
    "precision": "of the network: bf16-mixed, or 32-true, which CPUs without bfloat16 take in its place",
    "val_check_interval": "steps from validation to validation",
    "enable_progress_bar": "false for none",
}


def training_help(command: str, summary: str) -> str:
    """The help of a training command.

    Args:
        command: fit, validate, test or predict.
        summary: What it does, in one sentence.
    """
    own = {group: "\n".join(_entries(dict(_described(group)))) for group in SIGNATURES}
    shared = {"options": "\n".join(_entries(_OPTIONS)), "trainer": "\n".join(_entries(_TRAINER))}
    run = "--resume RUN" if command == "fit" else "RUN"
    return _TEXT.format(command=command, run=run, summary=summary, examples=_EXAMPLES[command], **shared, **own)


def _described(group: str) -> Iterator[tuple[str, str]]:
    """Arguments of --model.… or --data.…, in their order, and the first sentence about each."""
    known = argument_names(group) - LINKED[group]
    for file, name in SIGNATURES[group]:
        for key, text in _argument_texts(ast.get_docstring(class_definition(file, name)) or ""):
            if key in known:
                yield key, re.split(r"\. (?=[A-Z])|\.$", text)[0]


def _argument_texts(docstring: str) -> Iterator[tuple[str, str]]:
    """Names and texts of the section "Args:" of a docstring."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", docstring, flags=re.DOTALL | re.MULTILINE)
    for entry in re.split(r"\n(?=    \w)", section[1].rstrip() if section else ""):
        key, _, text = entry.strip().partition(": ")
        yield key, " ".join(text.split())


def _entries(described: dict[str, str]) -> Iterator[str]:
    for key, text in described.items():
        first, *others = textwrap.wrap(text, WIDTH - INDENT)
        start = f"  {key}".ljust(INDENT)
        yield start + first if len(start) == INDENT else f"{start}\n{' ' * INDENT}{first}"
        yield from (" " * INDENT + other for other in others)
