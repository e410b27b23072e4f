"""The one error that is the user's to mend, and the commands that its messages advise."""

import json
import shlex
import subprocess
import sys
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

DISTRIBUTION = "instant-avatar-stream"
"""Name of the installed package."""


class InputError(ValueError):
    """Input that cannot be used; the message says what is, what was expected and what to do.

    Whatever reads what a user gave raises it; docstrings say so only where a caller goes on after
    it.
    """


def quote_command(*words: object) -> str:
    """Return the words of a command line, quoted as this system's shell expects."""
    text = [str(word) for word in words]
    return subprocess.list2cmdline(text) if sys.platform == "win32" else shlex.join(text)


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: 1 frame, 2 frames."""
    return f"{number} {noun}{'s' * (number != 1)}"


def install_command(extras: str = "") -> str:
    """Return the command that adds extras to this installation, from where it was installed."""
    pip, checkout = (sys.executable, "-m", "pip", "install"), Path(__file__).resolve().parents[1]
    chosen = f"[{extras}]" if extras else ""
    if (checkout / "pyproject.toml").is_file():
        return quote_command(*pip, "-e", f"{checkout}{chosen}")
    named = f"{DISTRIBUTION}{chosen}"
    with suppress(PackageNotFoundError):
        origin = distribution(DISTRIBUTION).read_text("direct_url.json")
        if origin is not None:  # of a wheel, a folder or a repository, which no index may have
            source = json.loads(origin)
            kind = "git+" if "vcs_info" in source else ""
            return quote_command(*pip, f"{named} @ {kind}{source['url']}")
    return quote_command(*pip, named)
