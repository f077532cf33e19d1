"""The documents are true: commands exist, links lead somewhere, the model in the README is one."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from rtcomp.cli import cli
from rtcomp.model import parse_model
from rtcomp.signal_map import bundled_maps

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SHELL = "\n".join(re.findall(r"```sh\n(.*?)```", README, re.S))
SPOKEN = "\n".join(re.findall(r"`([^`\n]+)`", README)) + "\n" + SHELL


def test_readme_names_every_command_and_none_that_is_not():
    named = set(re.findall(r"\brtcomp ([a-z]+)", SPOKEN))
    assert named == set(cli.list_commands(None))


def test_options_in_readme_exist():
    for line in re.findall(r"^rtcomp .*$", SHELL, re.M):
        name = line.split()[1]
        known = {option for parameter in cli.get_command(None, name).params for option in parameter.opts}
        used = {word for word in line.split("#")[0].split() if re.fullmatch(r"--?[a-z-]+", word)}
        assert used <= known, line


def test_the_models_in_readme_are_models():
    blocks = re.findall(r"```json\n(.*?)```", README, re.S)
    assert blocks
    for block in blocks:
        assert parse_model(block, "README").schema == json.loads(block)["schema"]


def test_links_and_pictures_are_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("https://") or (ROOT / target).exists(), target


def test_ci_runs_readmes_own_test_command_and_readme_has_one():
    lines = [line for line in README.splitlines() if "python -m pytest" in line]
    assert len(lines) >= 1
    assert lines[0].startswith("python3 -m venv")
    assert 'grep -m1 "python -m pytest" README.md' in (ROOT / ".ci" / "run").read_text()


@pytest.mark.parametrize("name", sorted(bundled_maps()))
def test_readme_names_every_bundled_map(name):
    assert f"`{name}`" in README


def test_every_dependency_says_what_it_is_for():
    lines = (ROOT / "pyproject.toml").read_text().splitlines()
    needs = [line for line in lines if re.match(r'\s+"[A-Za-z0-9-]+(>=[\d.]+)",', line)]
    assert len(needs) > 15
    assert [
        line
        for line in needs
        if "#" not in line and not re.search("pytest>|ruff|pyright|import-linter|build>", line)
    ] == []
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = (ROOT / ".ci" / "constraints.txt").read_text().lower()
    for need in project["dependencies"]:
        assert re.split(r"[><=\[]", need)[0].lower() + "==" in pinned, need
