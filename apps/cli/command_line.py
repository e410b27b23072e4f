"""A command line as a record: what every command answers besides its own arguments.

Flags whose value may be left out: --view, --web and their ports, --turntable and its seconds.
"""

import io
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import field, fields, make_dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any, TypeVar

import tyro

DISTRIBUTION = "instant-avatar-stream"

HELP_FLAGS = frozenset({"-h", "--help"})

Arguments = TypeVar("Arguments")
Flag = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.arg(help="Say which version this is, and exit.", help_behavior_hint=""),
]


def parse_arguments(
    arguments_type: type[Arguments], program: str, argv: Sequence[str] | None = None
) -> Arguments:
    """The arguments of a command; --help and --version are answered, and end it.

    Args:
        kind: A dataclass; its docstrings are the --help.
        program: The command's name.
        words: What was typed; None for what the process was called with.

    Raises:
        SystemExit: With 0 once --help or --version was answered, 2 if the words make no sense.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    if "--version" in argv:
        print(f"{program} ({DISTRIBUTION}) {_installed_version()}")  # noqa: T201 - the answer to --version and --help
        raise SystemExit(0)
    own: list[tuple[str, Any, Any]] = [("version", Flag, field(default=False))]
    both: Any = make_dataclass(
        arguments_type.__name__, own, bases=(arguments_type,), frozen=True, kw_only=True
    )
    both.__doc__ = arguments_type.__doc__
    if HELP_FLAGS.isdisjoint(argv):
        told = tyro.cli(both, prog=program, args=argv)
    else:
        told = _parse_with_wrapped_help(both, program, argv)
    given = {each.name: getattr(told, each.name) for each in fields(both)}
    del given["version"]
    return arguments_type(**given)


def _parse_with_wrapped_help(arguments_type: Any, program: str, argv: Sequence[str]) -> Any:
    """As tyro does it, but paragraphs are lines that fit the terminal."""
    held = _CapturedStdout()
    try:
        with redirect_stdout(held):
            return tyro.cli(arguments_type, prog=program, args=argv)
    finally:
        print(_wrap_paragraphs(held.getvalue()), end="")  # noqa: T201 - the answer to --version and --help


def _installed_version() -> str:
    """Of the installed distribution."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return "(a checkout that is not installed)"


class _CapturedStdout(io.StringIO):
    """What is printed, held back; with the colours and the letters that stdout can show."""

    encoding = property(lambda self: getattr(sys.__stdout__, "encoding", "utf-8"))  # type: ignore[assignment]

    def isatty(self) -> bool:
        return sys.__stdout__ is not None and sys.__stdout__.isatty()


def _wrap_paragraphs(text: str) -> str:
    """Paragraphs, which tyro makes one line each, in lines of the terminal's width."""
    width = shutil.get_terminal_size().columns
    lines = [
        textwrap.fill(line, width) if line[:1].isalpha() or line[:1].isdigit() else line
        for line in text.split("\n")
    ]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines))


def fill_optional_port(argv: Sequence[str], flag: str, port: int) -> list[str]:
    """The command line with the port that may be left out after a flag."""
    return _fill_optional(argv, flag, str(port), lambda word: word.isdecimal())


def fill_optional_number(argv: Sequence[str], flag: str, value: float) -> list[str]:
    """The command line with the number that may be left out after a flag."""
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
    """argparse would take the next word for the value, whatever that is."""
    filled: list[str] = []
    for place, word in enumerate(argv):
        filled.append(word)
        after = argv[place + 1] if place + 1 < len(argv) else ""
        if word == flag and not is_value(after):
            filled.append(value)
    return filled
