"""The commands. They know every stage; no stage knows a command."""

import os
import sys
from pathlib import Path
from types import TracebackType

# Before anything imports torch: OpenMP threads that spin while they wait made two threads 4-15×
# slower on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
# numpy's own BLAS spins, too: a second thread doubled the cost of a frame's warp, for nothing.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Nobody is told what runs here (export/__init__.py says the same for those who import the player).
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


def _quiet_excepthook(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    """Ctrl-C while a command still loads what it needs is no fault, and shows none.

    Nor is a reader that has seen enough: `ia-play --help | head`.
    """
    if issubclass(kind, KeyboardInterrupt):
        print("stopped by Ctrl-C.", file=sys.stderr)  # noqa: T201 - there is no console yet
    elif issubclass(kind, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is still held back goes nowhere
    else:
        sys.__excepthook__(kind, error, traceback)


if Path(sys.argv[0]).name.startswith(("ia-", "-m")):  # a command, not somebody who imports one
    sys.excepthook = _quiet_excepthook
