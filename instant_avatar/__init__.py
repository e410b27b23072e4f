"""The commands. They import every stage; no stage imports a command."""

import os
import sys
from pathlib import Path
from types import TracebackType

# Set before torch is imported: OpenMP threads that spin while waiting made two threads 4-15×
# slower on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
# numpy's BLAS spins as well: a second thread doubled the cost of a frame's warp without gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Disable the telemetry of onnxruntime, as export/__init__.py does for library users.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


def _quiet_excepthook(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    """End without a traceback on Ctrl-C during imports, and on a closed pipe (`--help | head`)."""
    if issubclass(kind, KeyboardInterrupt):
        print("stopped by Ctrl-C.", file=sys.stderr)  # noqa: T201 - there is no console yet
    elif issubclass(kind, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # discard buffered output
    else:
        sys.__excepthook__(kind, error, traceback)


if Path(sys.argv[0]).name.startswith(("ia-", "-m")):  # a command, not an import of one
    sys.excepthook = _quiet_excepthook
