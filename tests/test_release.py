"""What belongs to a release: one version everywhere, and templates of issues that ask for what there is."""

import re
import tomllib

import pytest
import yaml

from nmpm import __version__
from nmpm._support.shipped import PACKAGE
from nmpm.cli import COMMANDS

ROOT = PACKAGE.parent
TEMPLATES = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml"))


def test_the_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["tool"]["hatch"]["version"]["path"] == "nmpm/_support/__init__.py"
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == __version__
    versions = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert next(version for version in versions if version != "Unreleased") == __version__


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_templates_of_issues_name_commands_that_exist(path):
    template = yaml.safe_load(path.read_text())
    assert {"name", "description", "body"} <= set(template)
    assert len({part["id"] for part in template["body"]}) == len(template["body"])
    commands = re.findall(r"nmpm ([a-z]+)", " ".join(str(part["attributes"]) for part in template["body"]))
    assert commands
    assert set(commands) <= set(COMMANDS)
