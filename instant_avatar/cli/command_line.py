"""Command lines of all commands: parsing, Ctrl-C, exit codes, and one message for each failure.

The first Ctrl-C requests a stop, the second one quits.
"""

import errno
import gc
import inspect
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from itertools import zip_longest
from types import MappingProxyType
from typing import Any, TypeVar, cast

import tyro
from docstring_parser import parse_from_object
from rich.console import Console as RichConsole
from rich.markup import escape

from capture.input_error import DISTRIBUTION, InputError, install_command
from instant_avatar.cli.console import Console, StderrConsole

DONE, NO_AVATAR, BAD_INPUT, RESOURCE_UNAVAILABLE, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit codes; 1: trained, but the avatar is not usable (failed, or nothing to draw)."""


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
    console: Console, closing_message: str = "saving the checkpoint"
) -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets; the second raises KeyboardInterrupt.

    On other threads than the main one the event is never set.
    """
    stop = threading.Event()

    def first(signal_number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop.set()
        console.info(f"Stopping; {closing_message}. Press Ctrl-C again to quit immediately.")

    with handle_signals({signal.SIGINT: first}):
        yield stop


@contextmanager
def exit_on_interrupt(
    console: Console, program: str, cleanup: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Exit the process immediately on Ctrl-C during this block.

    For imports, kernel compilation and native threads, where an exception in the main thread would
    turn into other errors or a crash.
    """

    def leave(signal_number: int, frame: object) -> None:
        cleanup()
        console.info_before_exit(f"{program}: stopped by Ctrl-C.")
        os._exit(INTERRUPTED)

    with handle_signals({signal.SIGINT: leave}):
        yield


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Collect no garbage during this block, which loads code: a fifth of the time of loading."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


EXTRAS = {
    **dict.fromkeys(("torch", "numba", "onnx", "pycolmap"), "learn"),
    **dict.fromkeys(("ray", "fsspec"), "learn,cluster"),
    "viser": "viewer",
    **dict.fromkeys(("aiohttp", "cryptography", "segno"), "phone"),
}
"""Optional packages, and the extras that install them."""


def require_packages(*names: str) -> None:
    """Raise a ModuleNotFoundError, before work is done, if a package is not installed."""
    for name in names:
        if find_spec(name) is None:
            raise ModuleNotFoundError(name=name)


def install_advice(error: ModuleNotFoundError) -> str | None:
    """Return what to install for a missing package; None if the module is not an optional one."""
    package = (error.name or "").split(".")[0]
    if package not in EXTRAS:
        return None
    able = ": this installation plays avatars, tracks people, checks captures and exports meshes"
    return (
        f"{package} is not installed{able if EXTRAS[package] == 'learn' else ''}. Install it: "
        f"{install_command(EXTRAS[package])}"
    )


class CommandExit(Exception):  # noqa: N818 - an exit, not always an error
    """Ends the command with a message and an exit code."""

    def __init__(self, message: str, code: int) -> None:
        """Set the message for the user and the exit code."""
        super().__init__(message)
        self.code = code


def run_command(program: str, work: Callable[[], int]) -> int:
    """Run a command; turn failures of user and machine into one message and an exit code.

    No usable avatar is 1, bad input or a missing package 2, a full disk or a busy device 3, Ctrl-C
    and SIGTERM 130. Bugs keep their traceback.
    """
    interrupted = threading.Event()

    def interrupt(signal_number: int, frame: object) -> None:
        interrupted.set()
        raise KeyboardInterrupt

    terminate = {signal.SIGTERM: lambda *_: signal.raise_signal(signal.SIGINT)}
    with handle_signals({signal.SIGINT: interrupt, **terminate}):
        try:
            return work()
        except BaseException as error:
            failure = describe_failure(error)
            if failure is None and interrupted.is_set():  # an import made another error of it
                failure = INTERRUPTED, "stopped by Ctrl-C."
            if failure is None:
                raise
    code, message = failure
    StderrConsole().print(f"[bold red]{program}:[/] {escape(message)}", highlight=False)
    return code


def describe_failure(error: BaseException) -> tuple[int, str] | None:
    """Return exit code and message of what user or machine has caused; None for a bug."""
    if isinstance(error, CommandExit):
        return error.code, str(error)
    if isinstance(error, InputError):
        return BAD_INPUT, str(error)
    if isinstance(error, ModuleNotFoundError):
        advice = install_advice(error)
        return None if advice is None else (BAD_INPUT, advice)
    failure = None
    if isinstance(error, KeyboardInterrupt):
        failure = INTERRUPTED, "stopped by Ctrl-C."
    elif isinstance(error, OSError):
        failure = _system_failure(error)
    elif isinstance(error, RuntimeError | MemoryError):
        message = str(error).strip() or "out of memory"
        phrases = ("out of memory", "busy or unavailable", "not enough memory")
        if isinstance(error, MemoryError) or any(each in message.lower() for each in phrases):
            advice = f"({message.splitlines()[0]}). Try a smaller --size."
            failure = RESOURCE_UNAVAILABLE, f"the device is out of memory or busy {advice}"
    if failure is None:
        return None
    return failure[0], " ".join([failure[1], *getattr(error, "__notes__", [])])


def _system_failure(error: OSError) -> tuple[int, str] | None:
    reason = f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    if is_disk_full(error):
        return RESOURCE_UNAVAILABLE, f"the disk is full ({reason}). Free some space."
    if error.errno == errno.EBUSY:
        return RESOURCE_UNAVAILABLE, f"a device is busy ({reason})."
    if error.errno in (
        errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR, errno.EISDIR,
        errno.ENAMETOOLONG, errno.ELOOP, errno.EEXIST,
    ):  # fmt: skip
        return BAD_INPUT, f"cannot read or write ({reason}). Choose another path."
    return None


def is_disk_full(error: OSError) -> bool:
    """True if a write failed because the disk is full."""
    return error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


Arguments = TypeVar("Arguments")


def parse_arguments(
    arguments_type: type[Arguments], program: str, argv: Sequence[str] | None = None
) -> Arguments:
    """Parse the arguments of a command, a dataclass whose docstrings are the --help.

    Raises:
        SystemExit: With 0 after --help or --version, with 2 if the words cannot be parsed.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    if "--version" in argv:
        print(f"{program} ({DISTRIBUTION}) {_installed_version()}")  # noqa: T201 - the answer
        raise SystemExit(0)
    if {"-h", "--help"} & set(argv):  # tyro would not wrap paragraphs
        _join_help_lines(arguments_type)
        about = f"{inspect.getdoc(arguments_type)}\n\n--version prints the version and exits.\n"
        paragraphs = re.sub(r"(?<=\S)\n(?=\S)", " ", about)
        RichConsole(highlight=False, markup=False).print(paragraphs)
    return tyro.cli(arguments_type, prog=program, args=argv, description="")


def run_main(
    program: str,
    arguments_type: type[Arguments],
    work: Callable[[Arguments, Console], int],
    argv: Sequence[str] | None,
) -> int:
    """Parse the arguments of a command, and run it; return its exit code."""
    given = parse_arguments(arguments_type, program, argv)
    return run_command(program, lambda: work(given, Console()))


def _join_help_lines(arguments_type: Any) -> None:
    """Set the help of each field to its docstring as one paragraph; tyro would keep line breaks."""
    for record in (arguments_type, *(field.default_factory for field in fields(arguments_type))):
        if is_dataclass(record):
            named = {field.name: field for field in fields(record)}
            for base in reversed(inspect.getmro(cast("type", record))[:-1]):
                for parameter in parse_from_object(base).params:
                    text = " ".join((parameter.description or "").split())
                    named[parameter.arg_name].metadata = MappingProxyType({"help": text})


def _installed_version() -> str:
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return "(checkout, not installed)"


def fill_optional_value(argv: Sequence[str], flag: str, value: int | float) -> list[str]:
    """Insert a default number after a flag that no number follows."""
    words: list[str] = []
    for word, following in zip_longest(argv, argv[1:], fillvalue=""):
        words.append(word)
        if word == flag and not re.fullmatch(r"-?[\d.]+|nan", following):
            words.append(f"{value:g}")
    return words
