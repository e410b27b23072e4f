"""Packages that an installation may lack, and the command that brings each.

How a command ends: one number for each kind of end, one message for each kind of failure.
"""

import errno
from collections.abc import Callable

from rich.markup import escape

from apps.cli.command_line import DISTRIBUTION
from apps.cli.console import StderrConsole
from apps.cli.interrupt import INTERRUPTED as INTERRUPTED
from apps.cli.interrupt import record_interrupt
from capture.input_error import InputError

LEARN_PACKAGES = frozenset({"torch", "numba", "onnx"})
"""What the extra [learn] brings besides `SMALL`: hundreds of megabytes that a player is spared."""
SMALL_PACKAGES = frozenset({"trimesh", "pycolmap"})
"""What it brings, too, but is soon installed alone."""


def install_advice(error: ModuleNotFoundError) -> str | None:
    """Say what to install for a package that is missing; None if the module is our own mistake.

    Args:
        error: What an import raised.
    """
    package = (error.name or "").split(".")[0]
    if package in LEARN_PACKAGES:
        return (
            f"{package} is not installed here: this is an installation that plays avatars, checks "
            "captures and exports meshes, but does not learn. For the rest: "
            f"pip install '{DISTRIBUTION}[learn]'"
        )
    if package in SMALL_PACKAGES:
        return f"{package} is not installed here. Install it: pip install {package}"
    return None


DONE, NO_AVATAR, BAD_INPUT, RESOURCE_UNAVAILABLE = 0, 1, 2, 3
"""1: learnt, and the result is no usable avatar (verdict "failed", or nothing to draw)."""

DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""The disk, the quota, or the largest size that a file may have."""
PERMISSION_ERRNOS = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})
PATH_ERRNOS = frozenset(
    {errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EEXIST}
)
"""Names that nothing can be read from or written to."""
DEVICE_BUSY_PHRASES = ("out of memory", "busy or unavailable", "not enough memory")
"""What torch says of a device that cannot be used now."""


class CommandExit(Exception):  # noqa: N818 - an exit, not always an error
    """Ends the command with a message and an exit code."""

    def __init__(self, message: str, code: int) -> None:
        """An end that is known and said."""
        super().__init__(message)
        self.code = code


def run_command(program: str, work: Callable[[], int]) -> int:
    """Runs a command's work; what a user or a machine can cause becomes one message and a number.

    No usable avatar is 1, bad input or a package that is not installed 2, a full disk or a busy
    device 3, Ctrl-C 130. Our own bugs keep their traceback.

    Args:
        program: The command's name, in front of the message.
        work: Returns its own exit code.
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
    except CommandExit as end:
        code, message = end.code, str(end)
    except InputError as error:
        code, message = BAD_INPUT, str(error)
    except ModuleNotFoundError as error:
        missing = install_advice(error)
        if missing is None:
            raise
        code, message = BAD_INPUT, missing
    except KeyboardInterrupt as error:
        code, message = INTERRUPTED, _with_notes("stopped by Ctrl-C.", error)
    except (OSError, RuntimeError, MemoryError) as error:
        failure = _machine_failure(error)
        if failure is None:
            raise
        code, message = failure[0], _with_notes(failure[1], error)
    print_error(program, message)
    return code


def print_error(program: str, message: str) -> None:
    """One message on stderr."""
    StderrConsole().print(f"[bold red]{program}:[/] {escape(message)}", highlight=False)


def is_disk_full(error: OSError) -> bool:
    """Whether a write failed for want of room."""
    return error.errno in DISK_FULL_ERRNOS


def _machine_failure(error: OSError | RuntimeError | MemoryError) -> tuple[int, str] | None:
    """Exit code and message of what the machine could not do; None for everything else."""
    if isinstance(error, OSError):
        why = f"{error.strerror}: {error.filename}" if error.filename else error.strerror
        if is_disk_full(error):
            return RESOURCE_UNAVAILABLE, f"the disk is full ({why}). Make room, or write elsewhere."
        if error.errno == errno.EBUSY:
            return RESOURCE_UNAVAILABLE, f"a device is busy ({why})."
        if error.errno in PERMISSION_ERRNOS | PATH_ERRNOS:
            return BAD_INPUT, f"cannot read or write there ({why}). Name another place."
        return None
    said = str(error).strip() or "out of memory"
    if isinstance(error, MemoryError) or any(
        words in said.lower() for words in DEVICE_BUSY_PHRASES
    ):
        first = said.splitlines()[0]
        return (
            RESOURCE_UNAVAILABLE,
            f"the device has no room or is busy ({first}). Try a smaller --size.",
        )
    return None


def _with_notes(message: str, error: BaseException) -> str:
    return " ".join([message, *getattr(error, "__notes__", [])])
