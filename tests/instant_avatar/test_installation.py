"""What plays, checks and exports without the packages that learning needs, and what says so."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import pytest

from capture import input_error
from instant_avatar.cli.command_line import EXTRAS, install_advice

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]

WITHOUT = """
import importlib, io, sys
from contextlib import redirect_stderr

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {absent!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
for words in {commands!r}:
    command, said = importlib.import_module("instant_avatar." + words[0]), io.StringIO()
    with redirect_stderr(said):
        code = command.main(words[1:])
    print(code, *said.getvalue().split())
"""
"""Runs commands one after the other where some packages cannot be imported."""
LEARN_PACKAGES = {name for name, extras in EXTRAS.items() if extras == "learn"}


def names(requirements: list[str]) -> set[str]:
    """Names as they are imported."""
    return {requirement.split(">=")[0].replace("-", "_") for requirement in requirements}


def without(absent: set[str], commands: list[list[str]], folder: Path) -> list[str]:
    """Exit code and message of each command, run in a folder without some packages."""
    code = WITHOUT.format(absent=absent, commands=commands)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [line for line in done.stdout.splitlines() if line[:2] in ("0 ", "1 ", "2 ")]


@pytest.fixture
def place(run, film, tmp_path) -> Path:
    """A folder that holds a package and poses, and nothing of a checkout."""
    shutil.copy(run / "avatar.iavatar", tmp_path)
    shutil.copy(film / "truth" / "novel" / "poses.npz", tmp_path)
    return tmp_path


def played(folder: Path) -> bool:
    """Whether a.png and a.webm show a person, and a.glb exists."""
    picture = cv2.imread(str(folder / "a.png"), cv2.IMREAD_UNCHANGED)
    clip, count = cv2.VideoCapture(str(folder / "a.webm")), 0
    while clip.grab():
        count += 1
    shown = 0.02 < (picture[..., 3] > 127).mean() < 0.5
    return shown and count == 12 and (folder / "a.glb").read_bytes()[:4] == b"glTF"


PLAY = [
    ["play", "avatar.iavatar", "--poses", "poses.npz", "--still", "3", "--size", "64",
     "--out", "a.png"],
    ["play", "avatar.iavatar", "--poses", "poses.npz", "--size", "64", "--out", "a.webm"],
    ["play", "avatar.iavatar", "--verify"],
    ["play", "avatar.iavatar", "--bench", "--size", "64"],
    ["export", "avatar.iavatar", "--to", "glb", "--triangles", "2000", "--out", "a.glb"],
    ["export", "avatar.iavatar", "--to", "ply", "--out", "a.ply"],
]  # fmt: skip


def test_what_learning_needs_is_an_extra():
    needed = names(PROJECT["dependencies"])
    assert names(PROJECT["optional-dependencies"]["learn"]) == LEARN_PACKAGES
    assert needed.isdisjoint(LEARN_PACKAGES)


@pytest.mark.slow
def test_playing_checking_and_meshes_need_nothing_of_it(place, film):
    commands = [*PLAY, ["check", str(film), "--sheet", "sheet.png"]]
    ended = without(LEARN_PACKAGES, commands, place)
    assert [line[0] for line in ended] == ["0"] * len(commands), ended
    assert played(place)


def test_commands_that_need_it_say_what_to_install(place, run, film):
    learn = f"-m pip install -e '{ROOT}[learn]'"
    wanted = [
        (["ingest", str(film), "--out", "run"], f"ia-ingest: torch is not installed.* {learn}"),
        (["evaluate", str(run)], f"ia-evaluate: torch is not installed.* {learn}"),
        (["sample", "film"], f"ia-sample: numba is not installed.* {learn}"),
        (["export", str(run), "--out", "a.iavatar"], f"ia-export: torch is not .* {learn}"),
    ]
    before = sorted(place.iterdir())
    ended = without(LEARN_PACKAGES, [words for words, _ in wanted], place)
    for line, (_, said) in zip(ended, wanted, strict=True):
        first, last = said.split(".*")[0], said.split(".*")[-1].strip()
        assert line.startswith("2 ")
        assert first in line
        assert last in line
        assert "Traceback" not in line
    assert sorted(place.iterdir()) == before


def test_a_module_of_our_own_that_is_missing_is_no_advice():
    assert (
        install_advice(
            ModuleNotFoundError("No module named 'instant_avatar.gone'", name="instant_avatar.gone")
        )
        is None
    )


@pytest.mark.parametrize(
    ("origin", "named"),
    [
        (None, "'instant-avatar-stream[viewer]'"),
        ({"url": "file:///w/i.whl"}, "'instant-avatar-stream[viewer] @ file:///w/i.whl'"),
        (
            {"url": "https://g/i", "vcs_info": {}},
            "'instant-avatar-stream[viewer] @ git+https://g/i'",
        ),
    ],
)
def test_the_advice_names_where_this_installation_came_from(origin, named, tmp_path, monkeypatch):
    """No index may have the package."""

    class Installed:
        def read_text(self, name: str) -> str | None:
            return None if origin is None else json.dumps(origin)

    monkeypatch.setattr(input_error, "__file__", str(tmp_path / "capture" / "input_error.py"))
    monkeypatch.setattr(input_error, "distribution", lambda name: Installed())
    advice = install_advice(ModuleNotFoundError(name="viser"))
    assert advice == f"viser is not installed. Install it: {sys.executable} -m pip install {named}"


def index_or_skip(folder: Path) -> None:
    """Skips the test where pip reaches no package index."""
    probe = [*PIP, "download", "--no-deps", "-d", str(folder), "jaxtyping", "--retries", "1"]
    asked = subprocess.run(probe, capture_output=True, text=True, check=False)
    if asked.returncode:
        reason = (asked.stderr.strip().splitlines() or ["no reason given"])[-1]
        pytest.skip(f"pip reaches no package index: {reason}")


@pytest.mark.slow
def test_an_installation_without_extras_plays(place, tmp_path_factory):
    """A wheel of this checkout in a fresh environment: 150 MB of other wheels, cached by pip."""
    folder = tmp_path_factory.mktemp("installation")
    index_or_skip(folder)
    source, environment = folder / "source", folder / "venv"
    for stage in ("capture", "preprocess", "avatar", "export", "instant_avatar"):
        shutil.copytree(ROOT / stage, source / stage, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "constraints.txt"):
        shutil.copy(ROOT / name, source)
    subprocess.run([*PIP, "wheel", "--no-deps", "-w", folder, source], check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    (wheel,) = folder.glob("instant_avatar_stream-*.whl")
    python = environment / "bin" / "python"
    into = [sys.executable, "-m", "pip", "--python", str(python), "-q", "install"]
    subprocess.run([*into, "-c", source / "constraints.txt", wheel], check=True)
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def call(*words: object) -> str:
        done = subprocess.run(
            [str(word) for word in words], cwd=place, env=clean, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    absent = sorted(LEARN_PACKAGES)
    looked = f"from importlib.util import find_spec; print([*map(find_spec, {absent})])"
    assert call(python, "-c", looked).strip() == str([None] * len(absent))
    for command, *words in PLAY:
        call(environment / "bin" / f"ia-{command}", *words)
    assert played(place)
