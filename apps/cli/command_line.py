"""Command lines of all commands: parsing, Ctrl-C, exit codes, and one message for each failure.

The first Ctrl-C requests a stop, the second one quits.
"""

import errno
import io
import os
import re
import shutil
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import field, fields, make_dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any, TypeVar

import tyro
from rich.markup import escape

from apps.cli.console import Console, StderrConsole
from capture.input_error import InputError

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended."""


@contextmanager
def handle_signals(handlers: dict[signal.Signals, Callable[[int, Any], object]]) -> Iterator[None]:
    """Handle signals by functions during a block; they reach the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def stop_on_interrupt(
    console: Console, saving_message: str = "saving the checkpoint"
) -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets; the second raises KeyboardInterrupt.

    On other threads than the main one the event is never set.

    Args:
        console: Shows that the work is stopping.
        saving_message: What happens to the work done.
    """
    stop = threading.Event()

    def first(signal_number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop.set()
        console.info(f"Stopping; {saving_message}. Press Ctrl-C again to quit immediately.")

    with handle_signals({signal.SIGINT: first}):
        yield stop


@contextmanager
def exit_on_interrupt(
    console: Console, program: str, cleanup: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Exit the process immediately on Ctrl-C during this block.

    For imports, kernel compilation and native threads, where an exception in the main thread would
    turn into other errors or a crash.

    Args:
        console: Restores the terminal.
        program: Name of the command, in front of the message.
        cleanup: Called before the process exits.
    """

    def leave(signal_number: int, frame: object) -> None:
        cleanup()
        console.info_before_exit(f"{program}: stopped by Ctrl-C.")
        os._exit(INTERRUPTED)

    with handle_signals({signal.SIGINT: leave}):
        yield


@contextmanager
def record_interrupt() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets; KeyboardInterrupt is still raised.

    A module being imported may turn the exception into its own error; the event remains set.
    SIGTERM is treated like Ctrl-C. On other threads than the main one the event is never set.
    """
    came = threading.Event()

    def note(signal_number: int, frame: object) -> None:
        came.set()
        raise KeyboardInterrupt

    ends = {signal.SIGINT: note, signal.SIGTERM: lambda *_: signal.raise_signal(signal.SIGINT)}
    with handle_signals(ends):
        yield came


@contextmanager
def interrupt_event() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets without raising an exception.

    A KeyboardInterrupt could be swallowed by the callback that it is raised in. On other threads
    than the main one the event is never set.
    """
    ended = threading.Event()
    with handle_signals({signal.SIGINT: lambda *_: ended.set()}):
        yield ended


LEARN_PACKAGES = frozenset({"torch", "numba", "onnx"})
"""Large packages of the extra [learn], which playing does not need."""
SMALL_PACKAGES = frozenset({"trimesh", "pycolmap", "fast_simplification"})
"""Small packages of the extra [learn], which can be installed alone."""


def install_advice(error: ModuleNotFoundError) -> str | None:
    """Return what to install for a missing package; None if the module is not an optional one."""
    package = (error.name or "").split(".")[0]
    if package in LEARN_PACKAGES:
        return (
            f"{package} is not installed: this installation plays avatars, tracks people, checks "
            "captures and exports meshes, but cannot train. To train: pip install "
            f"'{DISTRIBUTION}[learn]'"
        )
    if package in SMALL_PACKAGES:
        return f"{package} is not installed. Install it: pip install {package}"
    return None


DONE, NO_AVATAR, BAD_INPUT, RESOURCE_UNAVAILABLE = 0, 1, 2, 3
"""Exit codes; 1: trained, but the avatar is not usable (failed, or nothing to draw)."""

DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Disk full, quota exceeded, or file too large."""
PERMISSION_ERRNOS = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})
"""Missing permission to read or write."""
PATH_ERRNOS = frozenset(
    {errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EEXIST}
)
"""Paths that cannot be read or written."""
DEVICE_BUSY_PHRASES = ("out of memory", "busy or unavailable", "not enough memory")
"""Phrases of torch for a device without memory or in use."""


class CommandExit(Exception):  # noqa: N818 - an exit, not always an error
    """Ends the command with a message and an exit code."""

    def __init__(self, message: str, code: int) -> None:
        """Set the message for the user and the exit code."""
        super().__init__(message)
        self.code = code


def run_command(program: str, work: Callable[[], int]) -> int:
    """Run a command; turn failures of user and machine into one message and an exit code.

    No usable avatar is 1, bad input or a missing package 2, a full disk or a busy device 3, Ctrl-C
    130. Bugs keep their traceback.

    Args:
        program: Name of the command, in front of the message.
        work: Returns the exit code of a command that does not fail.
    """
    with record_interrupt() as interrupted:
        try:
            return _run_translating_errors(program, work)
        except Exception:
            if not interrupted.is_set():
                raise
    print_error(program, "stopped by Ctrl-C.")
    return INTERRUPTED


def _run_translating_errors(program: str, work: Callable[[], int]) -> int:
    try:
        return work()
    except (Exception, KeyboardInterrupt) as error:
        failure = describe_failure(error)
        if failure is None:
            raise
        print_error(program, failure[1])
        return failure[0]


def describe_failure(error: BaseException) -> tuple[int, str] | None:
    """Return exit code and message of what user or machine has caused; None for a bug."""
    match error:
        case CommandExit():
            return error.code, str(error)
        case InputError():
            return BAD_INPUT, str(error)
        case ModuleNotFoundError():
            advice = install_advice(error)
            return None if advice is None else (BAD_INPUT, advice)
        case KeyboardInterrupt():
            return INTERRUPTED, _with_notes("stopped by Ctrl-C.", error)
        case OSError() | RuntimeError() | MemoryError():
            failure = _machine_failure(error)
            return None if failure is None else (failure[0], _with_notes(failure[1], error))
    return None


def print_error(program: str, message: str) -> None:
    """Print one message to stderr."""
    StderrConsole().print(f"[bold red]{program}:[/] {escape(message)}", highlight=False)


def is_disk_full(error: OSError) -> bool:
    """Whether a write failed because the disk is full."""
    return error.errno in DISK_FULL_ERRNOS


def _machine_failure(error: OSError | RuntimeError | MemoryError) -> tuple[int, str] | None:
    """Exit code and message of what the machine could not do; None for everything else."""
    if isinstance(error, OSError):
        why = f"{error.strerror}: {error.filename}" if error.filename else error.strerror
        if is_disk_full(error):
            return (
                RESOURCE_UNAVAILABLE,
                f"the disk is full ({why}). Free some space.",
            )
        if error.errno == errno.EBUSY:
            return RESOURCE_UNAVAILABLE, f"a device is busy ({why})."
        if error.errno in PERMISSION_ERRNOS | PATH_ERRNOS:
            return BAD_INPUT, f"cannot read or write ({why}). Choose another path."
        return None
    message = str(error).strip() or "out of memory"
    if isinstance(error, MemoryError) or any(
        words in message.lower() for words in DEVICE_BUSY_PHRASES
    ):
        first = message.splitlines()[0]
        return (
            RESOURCE_UNAVAILABLE,
            f"the device is out of memory or busy ({first}). Try a smaller --size.",
        )
    return None


def _with_notes(message: str, error: BaseException) -> str:
    return " ".join([message, *getattr(error, "__notes__", [])])


DISTRIBUTION = "instant-avatar-stream"
"""Name of the installed package."""

HELP_FLAGS = frozenset({"-h", "--help"})
"""Flags that print the help."""

Arguments = TypeVar("Arguments")
Flag = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.arg(help="Print the version and exit.", help_behavior_hint=""),
]


def parse_arguments(
    arguments_type: type[Arguments], program: str, argv: Sequence[str] | None = None
) -> Arguments:
    """Parse the arguments of a command; --help and --version print and exit.

    Args:
        arguments_type: A dataclass; its docstrings are the --help.
        program: Name of the command.
        argv: Words of the command line; None for those of the process.

    Raises:
        SystemExit: With 0 after --help or --version, with 2 if the words cannot be parsed.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    if "--version" in argv:
        print(f"{program} ({DISTRIBUTION}) {_installed_version()}")  # noqa: T201 - the answer to --version
        raise SystemExit(0)
    own: list[tuple[str, Any, Any]] = [("version", Flag, field(default=False))]
    both: Any = make_dataclass(
        arguments_type.__name__, own, bases=(arguments_type,), frozen=True, kw_only=True
    )
    both.__doc__ = arguments_type.__doc__
    if HELP_FLAGS.isdisjoint(argv):
        parsed = tyro.cli(both, prog=program, args=argv)
    else:
        parsed = _parse_with_wrapped_help(both, program, argv)
    given = {each.name: getattr(parsed, each.name) for each in fields(both)}
    del given["version"]
    return arguments_type(**given)


def _parse_with_wrapped_help(arguments_type: Any, program: str, argv: Sequence[str]) -> Any:
    """Parse like tyro, but wrap the paragraphs of --help to the terminal."""
    captured = _CapturedStdout()
    try:
        with redirect_stdout(captured):
            return tyro.cli(arguments_type, prog=program, args=argv)
    finally:
        print(_wrap_paragraphs(captured.getvalue()), end="")  # noqa: T201 - the answer to --help


def _installed_version() -> str:
    """Return the version of the installed package."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return "(checkout, not installed)"


class _CapturedStdout(io.StringIO):
    """Captures what is printed, with the colors and the encoding of stdout."""

    encoding = property(lambda self: getattr(sys.__stdout__, "encoding", "utf-8"))  # type: ignore[assignment]

    def isatty(self) -> bool:
        return sys.__stdout__ is not None and sys.__stdout__.isatty()


def _wrap_paragraphs(text: str) -> str:
    """Wrap paragraphs, each of which tyro prints as one line, to the terminal's width."""
    width = shutil.get_terminal_size().columns
    lines = [
        textwrap.fill(line, width) if line[:1].isalpha() or line[:1].isdigit() else line
        for line in text.split("\n")
    ]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines))


def fill_optional_port(argv: Sequence[str], flag: str, port: int) -> list[str]:
    """Insert a default port after a flag that has none."""
    return _fill_optional(argv, flag, str(port), lambda word: word.isdecimal())


def fill_optional_number(argv: Sequence[str], flag: str, value: float) -> list[str]:
    """Insert a default number after a flag that has none."""
    return _fill_optional(argv, flag, f"{value:g}", _is_number)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _fill_optional(
    argv: Sequence[str], flag: str, value: str, is_value: Callable[[str], bool]
) -> list[str]:
    """Insert a value after a flag unless one follows; argparse would take any next word."""
    filled: list[str] = []
    for place, word in enumerate(argv):
        filled.append(word)
        after = argv[place + 1] if place + 1 < len(argv) else ""
        if word == flag and not is_value(after):
            filled.append(value)
    return filled
