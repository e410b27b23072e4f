"""What every command answers besides its own arguments."""

import importlib
import tomllib
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import pytest

from instant_avatar.cli import command_line

ROOT = Path(__file__).parents[3]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
COMMANDS = {
    **SCRIPTS,
    "python -m instant_avatar.animation.web_server": "instant_avatar.animation.web_server:main",
}


def answered(program, words, capsys):
    """What a command says before it does anything."""
    module, function = COMMANDS[program].split(":")
    with pytest.raises(SystemExit) as end:
        getattr(importlib.import_module(module), function)(words)
    assert end.value.code == 0
    said = capsys.readouterr()
    assert said.err == ""
    return said.out


@pytest.mark.parametrize("program", COMMANDS)
def test_every_command_knows_its_version(program, capsys):
    distribution = command_line.DISTRIBUTION
    told = f"{program} ({distribution}) {version(distribution)}\n"
    assert answered(program, ["--version"], capsys) == told


@pytest.mark.parametrize("width", [80, 100])
@pytest.mark.parametrize("program", COMMANDS)
def test_help_is_paragraphs_that_fill_the_terminal(program, width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    text = answered(program, ["--help"], capsys)
    assert f"usage: {program} [-h]" in text
    assert "Exit codes: 0 " in text
    assert "None" not in text
    assert max(map(len, text.splitlines())) <= width
    about, options = text.split("\nusage: ")
    for above, below in pairwise(about.splitlines()):
        assert above[:4] != "    " or not below or below.startswith("    ia-"), "a wrapped example"
        if above[:1].strip() and below:
            assert len(above.rstrip()) + 1 + len(below.split()[0]) > width, above
    boxed = [line[2:-2] for line in options.splitlines() if line[:2] in ("│ ", "  ")]
    column = next(line.index("show this") for line in boxed if "show this" in line)
    for above, below in pairwise(boxed):
        if below.strip() and not below[:column].strip() and above[column - 2 : column] == "  ":
            assert len(above.rstrip()) + 1 + len(below.split()[0]) > width - 4, above


def test_a_checkout_has_a_version_without_installation(capsys, monkeypatch):
    monkeypatch.setattr(command_line, "DISTRIBUTION", "a-package-that-is-not-installed")
    assert "not installed" in answered("ia-play", ["--version"], capsys)


def test_words_that_make_no_sense_are_bad_input(capsys):
    with pytest.raises(SystemExit) as end:
        importlib.import_module("instant_avatar.animation.web_server").main(["--bogus"])
    assert end.value.code == 2
    assert "--bogus" in capsys.readouterr().err


@pytest.mark.parametrize("program", ["ia-check", "ia-ingest"])
def test_masks_cannot_be_dark_and_bright(program, capsys):
    module, function = COMMANDS[program].split(":")
    words = ["capture", "--mask-invert", "--no-mask-invert"]
    assert getattr(importlib.import_module(module), function)(words) == 2
    assert "mutually exclusive" in capsys.readouterr().err
