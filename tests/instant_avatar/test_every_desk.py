"""Commands on a machine like those with Windows: no Unix-only modules and calls, other paths."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from capture.input_error import quote_command

ROOT = Path(__file__).parents[2]

FOREIGN_DESK = """
import builtins, importlib, os, signal, sys, warnings

ABSENT = {{"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog"}}
STANDARD = {{"pathlib", "shutil", "tempfile", "importlib", "zipfile", "contextlib", "os", "io"}}
import_module = builtins.__import__

def import_ours(name, globals=None, *more, **named):
    if name in ABSENT and is_ours((globals or {{}}).get("__file__") or ""):
        raise ModuleNotFoundError("No module named " + name, name=name)
    return import_module(name, globals, *more, **named)

builtins.__import__ = import_ours
for name in ("fork", "forkpty", "killpg", "getpgid", "setsid", "getuid", "geteuid", "mkfifo",
             "sched_getaffinity", "statvfs", "getloadavg", "O_DIRECTORY", "O_NOFOLLOW"):
    vars(os).pop(name, None)
for name in ("SIGKILL", "SIGALRM", "SIGHUP", "SIGUSR1", "SIGQUIT", "setitimer", "ITIMER_REAL",
             "pthread_sigmask", "alarm", "pause"):
    vars(signal).pop(name, None)

def opener():
    "The file of ours, or of a library, that opens a file."
    frame = sys._getframe(2)
    while frame.f_globals["__name__"].split(".")[0] in STANDARD:
        frame = frame.f_back
    return frame.f_code.co_filename

def is_ours(name):
    return name.startswith({root!r}) and ".venv" not in name

def held_open(path):
    "Whether this process holds the file, or one in the folder: it could not be moved elsewhere."
    if not os.path.isdir("/proc/self/fd"):
        return False
    real, used = os.path.realpath(path), []
    for number in os.listdir("/proc/self/fd"):
        try:
            used.append(os.readlink("/proc/self/fd/" + number))
        except OSError:
            pass
    with open("/proc/self/maps", encoding="utf-8") as maps:
        used += [line.rstrip().split(None, 5)[-1] for line in maps]
    return any(name == real or name.startswith(real + "/") for name in used)

def watch(event, values):
    path = os.fsdecode(values[0]) if values and isinstance(values[0], (str, bytes)) else ""
    if event == "open" and path.startswith(("/proc", "/sys")) and is_ours(opener()):
        raise FileNotFoundError(2, "there is no such folder here", path)
    if event == "open" and values[1] and set(str(values[1])) & set("wax+") and is_ours(opener()):
        assert not set(os.path.basename(path)) & set('<>:"|?*'), "no name of a file: " + path
    if event in ("os.rename", "os.remove") and is_ours(opener()) and held_open(path):
        raise PermissionError(13, "another program uses this file", path)

ours = r"(capture|preprocess|avatar|export|instant_avatar)[.]"
warnings.filterwarnings("error", category=EncodingWarning, module=ours)
sys.addaudithook(watch)
for command, *words in {commands!r}:
    code = importlib.import_module("instant_avatar." + command).main(words)
    print(command, code)
"""
"""Runs commands where Unix-only modules, calls and folders are missing, and open files stay."""


def call_elsewhere(*commands: list[object], folder: Path) -> tuple[list[str], str]:
    """Names and exit codes of commands run in a folder of such a machine, and what they said."""
    words = [[str(word) for word in command] for command in commands]
    code = FOREIGN_DESK.format(root=str(ROOT), commands=words)
    strict = ["-X", "warn_default_encoding", "-W", "ignore::EncodingWarning"]
    own = {"PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(
        [sys.executable, *strict, "-c", code], cwd=folder, check=False, encoding="cp1252",
        capture_output=True, env={**os.environ, **own},
    )  # fmt: skip
    ended = [line for line in done.stdout.splitlines() if re.fullmatch(r"[a-z]+ \d+", line)]
    return ended, done.stderr


@pytest.mark.slow
def test_a_folder_with_spaces_and_umlauts_is_tracked_learnt_and_played(film, tmp_path):
    place = tmp_path / "Maßband & Größe, 'März'"
    place.mkdir()
    shutil.copy(film / "video.mp4", place / "Müller \\ Söhne.mp4")
    shutil.copytree(film, place / "Aufnahme 1")
    ended, said = call_elsewhere(
        ["track", "Müller \\ Söhne.mp4", "--out", "Spur ä/poses.npz", "--frames", "0:8"],
        ["ingest", "Aufnahme 1", "--out", "Lauf ö", "--steps", "30"],
        ["play", "Lauf ö/avatar.iavatar", "--poses", "Aufnahme 1/dance.npz", "--still", "3",
         "--size", "64", "--out", "Bild ü.png"],
        ["play", "Lauf ö/avatar.iavatar", "--size", "64", "--out", "Film ß.mp4"],
        folder=place,
    )  # fmt: skip
    assert ended == ["track 1", "ingest 0", "play 0", "play 0"], said  # 8 frames of 64 px are few


@pytest.mark.parametrize(
    ("system", "quoted"),
    [("linux", "ia-play 'a b/c.iavatar'"), ("win32", 'ia-play "a b/c.iavatar"')],
)
def test_advised_commands_are_quoted_for_the_shell_of_the_system(system, quoted, monkeypatch):
    monkeypatch.setattr(sys, "platform", system)
    assert quote_command("ia-play", Path("a b/c.iavatar")) == quoted
