"""A command line as a record: what every command answers besides its own arguments."""

import io
import re
import shutil
import sys
import textwrap
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import field, fields, make_dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any, TypeVar

import tyro

DISTRIBUTION = "instant-avatar-stream"

HELP = frozenset({"-h", "--help"})

Arguments = TypeVar("Arguments")
Flag = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.arg(help="Say which version this is, and exit.", help_behavior_hint=""),
]


def parsed(kind: type[Arguments], program: str, words: Sequence[str] | None = None) -> Arguments:
    """The arguments of a command; --help and --version are answered, and end it.

    Args:
        kind: A dataclass; its docstrings are the --help.
        program: The command's name.
        words: What was typed; None for what the process was called with.

    Raises:
        SystemExit: With 0 once --help or --version was answered, 2 if the words make no sense.
    """
    words = sys.argv[1:] if words is None else list(words)
    if "--version" in words:
        print(f"{program} ({DISTRIBUTION}) {_version()}")  # noqa: T201 - what was asked for
        raise SystemExit(0)
    own: list[tuple[str, Any, Any]] = [("version", Flag, field(default=False))]
    both: Any = make_dataclass(kind.__name__, own, bases=(kind,), frozen=True, kw_only=True)
    both.__doc__ = kind.__doc__
    if HELP.isdisjoint(words):
        told = tyro.cli(both, prog=program, args=words)
    else:
        told = _told_or_helped(both, program, words)
    given = {each.name: getattr(told, each.name) for each in fields(both)}
    del given["version"]
    return kind(**given)


def _told_or_helped(kind: Any, program: str, words: Sequence[str]) -> Any:
    """As tyro does it, but paragraphs are lines that fit the terminal."""
    held = _Held()
    try:
        with redirect_stdout(held):
            return tyro.cli(kind, prog=program, args=words)
    finally:
        print(_in_lines(held.getvalue()), end="")  # noqa: T201 - what was asked for


def _version() -> str:
    """Of the installed distribution."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return "(a checkout that is not installed)"


class _Held(io.StringIO):
    """What is printed, held back; with the colours and the letters that stdout can show."""

    encoding = property(lambda self: getattr(sys.__stdout__, "encoding", "utf-8"))  # type: ignore[assignment]

    def isatty(self) -> bool:
        return sys.__stdout__ is not None and sys.__stdout__.isatty()


def _in_lines(text: str) -> str:
    """Paragraphs, which tyro makes one line each, in lines of the terminal's width."""
    width = shutil.get_terminal_size().columns
    lines = [
        textwrap.fill(line, width) if line[:1].isalpha() or line[:1].isdigit() else line
        for line in text.split("\n")
    ]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines))
