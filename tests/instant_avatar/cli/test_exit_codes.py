"""How commands end, their help, and files that appear whole or not at all."""

import errno
import importlib
import io
import os
import signal
import subprocess
import sys
import tomllib
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import pytest
from rich.console import Console as RichConsole

from capture.input_error import InputError
from instant_avatar import check, ingest
from instant_avatar.animation import web_server
from instant_avatar.cli import command_line
from instant_avatar.cli.command_line import CommandExit, run_command, stop_on_interrupt
from instant_avatar.cli.console import MAX_PRINTED_WARNINGS, Console


def raising(error):
    def work():
        raise error

    return work


def run_python(code):
    """The end of a program."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=50)


FULL = OSError(errno.ENOSPC, "No space left on device")
FULL.add_note("The checkpoint is kept.")


@pytest.mark.parametrize(
    ("error", "code", "word"),
    [
        (FULL, 3, "The checkpoint is kept."),
        (InputError("3 poses for 4 frames"), 2, "3 poses for 4 frames"),
        (OSError(errno.ENOSPC, "No space left on device"), 3, "full"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), 3, "full"),
        (OSError(errno.EBUSY, "Device or resource busy"), 3, "busy"),
        (RuntimeError("CUDA error: out of memory\nat line 3"), 3, "out of memory"),
        (PermissionError(errno.EACCES, "Permission denied", "/out"), 2, "/out"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "xxx"), 2, "too long: xxx"),
        (OSError(errno.ELOOP, "Too many levels of symbolic links", "a"), 2, "Choose another path"),
        (MemoryError(), 3, "memory"),
        (KeyboardInterrupt(), 130, "Ctrl-C"),
        (CommandExit("too [blurred]", 1), 1, "too [blurred]"),
    ],
)
def test_each_failure_has_its_number_and_one_message(error, code, word, capsys):
    assert run_command("ia-test", raising(error)) == code
    said = capsys.readouterr().err
    assert said.startswith("ia-test: ")
    assert word in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("error", [ZeroDivisionError(), RuntimeError("shape"), OSError(5, "EIO")])
def test_our_own_faults_keep_their_traceback(error):
    with pytest.raises(type(error)):
        run_command("ia-test", raising(error))


def test_what_an_import_makes_of_ctrl_c_is_still_ctrl_c(capsys):
    def half_imported():
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None

    before = signal.getsignal(signal.SIGINT)
    assert run_command("ia-test", half_imported) == 130
    assert capsys.readouterr().err == "ia-test: stopped by Ctrl-C.\n"
    assert signal.getsignal(signal.SIGINT) is before


def test_a_machine_that_asks_for_an_end_is_answered_like_ctrl_c(capsys):
    before = signal.getsignal(signal.SIGTERM)
    assert run_command("ia-test", lambda: signal.raise_signal(signal.SIGTERM) or 0) == 130
    assert capsys.readouterr().err == "ia-test: stopped by Ctrl-C.\n"
    assert signal.getsignal(signal.SIGTERM) is before
    said = Console(RichConsole(file=io.StringIO()))

    def saves():
        with stop_on_interrupt(said) as stop:
            signal.raise_signal(signal.SIGTERM)
            return 130 if stop.is_set() else 0

    assert run_command("ia-test", saves) == 130


def test_where_nothing_is_to_be_saved_ctrl_c_does_not_wait_for_other_threads():
    """They would have a tree taken away from under them, and the process would crash."""
    code = (
        "import os, signal, threading, time\n"
        "from instant_avatar.cli.console import Console\n"
        "from instant_avatar.cli.command_line import exit_on_interrupt\n"
        "with exit_on_interrupt(Console(), 'ia-test'):\n"
        "    threading.Thread(target=time.sleep, args=(60,)).start()\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(60)\n"
    )
    done = run_python(code)
    assert done.returncode == 130
    assert done.stderr == "ia-test: stopped by Ctrl-C.\n"


@pytest.mark.parametrize(("name", "shown"), [("ia-play", False), ("mine.py", True)])
def test_a_command_that_is_stopped_while_it_loads_shows_no_traceback(name, shown):
    code = f"import sys; sys.argv = ['/bin/{name}']; import instant_avatar; raise KeyboardInterrupt"
    done = run_python(code)
    assert ("Traceback" in done.stderr) is shown
    assert done.returncode != 0


def test_a_reader_that_has_seen_enough_is_no_fault():
    printing = "[print('x' * 999) for _ in range(999)]"
    code = f"import sys; sys.argv = ['ia-play']; import instant_avatar; {printing}"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""


def test_work_continues_when_its_output_is_closed():
    code = (
        "import sys\n"
        "from instant_avatar.cli.console import Console\n"
        "from instant_avatar.cli.command_line import CommandExit, run_command\n"
        "def work():\n"
        "    for _ in range(99): Console().info('x' * 999)\n"
        "    print('done', flush=True)\n"
        "    raise CommandExit('too late', 2)\n"
        "sys.exit(run_command('ia-test', work))\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stderr.readline()
        process.stderr.close()
        assert process.stdout.read() == b"done\n"
        assert process.wait(timeout=50) == 2


def test_warnings_are_said_once_and_not_for_ever():
    said = io.StringIO()
    console = Console(RichConsole(file=said, soft_wrap=True))
    for number in range(MAX_PRINTED_WARNINGS + 3):
        console.warning(f"frame {number} [bold]")
        console.warning(f"frame {number} [bold]")
    console.summarize_warnings()
    assert said.getvalue().count("frame") == MAX_PRINTED_WARNINGS
    assert "and 3 more" in said.getvalue()
    assert "[bold]" in said.getvalue()
    assert len(console.warnings) == MAX_PRINTED_WARNINGS + 3


def test_a_note_asks_for_nothing_and_is_no_warning():
    printed = io.StringIO()
    console = Console(RichConsole(file=printed, soft_wrap=True))
    for _ in range(2):
        console.note("the masks were refined")
    assert printed.getvalue() == "the masks were refined\n"
    assert (console.notes, console.warnings) == (["the masks were refined"], [])


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


def test_words_that_make_no_sense_are_bad_input(call):
    ended = call(web_server, "--bogus")
    assert ended.code == 2
    assert "--bogus" in ended.err


@pytest.mark.parametrize("command", [check, ingest])
def test_masks_cannot_be_dark_and_bright(command, call):
    refusal = call(command, "capture", "--mask-invert", "--no-mask-invert").refusal()
    assert "mutually exclusive" in refusal
