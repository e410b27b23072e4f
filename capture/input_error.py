"""The one error that is the user's to mend, and the commands that its messages advise."""

import shlex
import subprocess
import sys


class InputError(ValueError):
    """Input that cannot be used; the message says what is, what was expected and what to do."""


def quote_command(*words: object) -> str:
    """Return the words of a command line, quoted as this system's shell expects."""
    text = [str(word) for word in words]
    return subprocess.list2cmdline(text) if sys.platform == "win32" else shlex.join(text)
