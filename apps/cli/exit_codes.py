"""Exit codes of the commands, and one message for each kind of failure."""

import errno
from collections.abc import Callable

from rich.markup import escape

from apps.cli.command_line import DISTRIBUTION
from apps.cli.console import StderrConsole
from apps.cli.interrupt import INTERRUPTED as INTERRUPTED
from apps.cli.interrupt import record_interrupt
from capture.input_error import InputError

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
