"""Command lines parsed into records, with --help, --version and flags with optional values."""

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
