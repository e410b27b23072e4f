"""A phone video walks in, an avatar walks out.

    from instant_avatar import Player, train

    avatar = train("video.mp4", "run", seconds=60)
    rgba = Player.load(avatar.package).render(pose, camera)

Names are loaded at their first use: a player never imports torch. The commands are modules of this
package; it imports every stage, and no stage imports it.
"""

import importlib
import os
import sys
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from capture.camera import Camera as Camera
    from capture.input_error import InputError as InputError
    from export.player import Player as Player
    from instant_avatar.trained_avatar import train as train
    from preprocess.body.body_pose import BodyPose as BodyPose
    from preprocess.body.kinematics import JOINT_NAMES as JOINT_NAMES

# Set before torch is imported: OpenMP threads that spin while waiting made two threads 4-15×
# slower on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
# numpy's BLAS spins as well: a second thread doubled the cost of a frame's warp without gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Disable the telemetry of onnxruntime, as export/__init__.py does for library users.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


STAGES = ("capture", "preprocess", "avatar", "export", "instant_avatar")
"""Packages of this distribution."""


def _quiet_excepthook(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    """End without a traceback on Ctrl-C during imports, and on a closed pipe (`--help | head`)."""
    if issubclass(kind, KeyboardInterrupt):
        print("stopped by Ctrl-C.", file=sys.stderr)  # noqa: T201 - there is no console yet
    elif issubclass(kind, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # discard buffered output
    elif isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] not in STAGES:
        print(  # noqa: T201
            f"{error.name} is not installed. Install this program again with what it depends on; "
            f"this lists what is missing: {sys.executable} -m pip check",
            file=sys.stderr,
        )
    else:
        sys.__excepthook__(kind, error, traceback)


if Path(sys.argv[0]).name.startswith(("ia-", "-m")):  # a command, not an import of one
    sys.excepthook = _quiet_excepthook


PUBLIC_NAMES = {
    "BodyPose": "preprocess.body.body_pose",
    "Camera": "capture.camera",
    "InputError": "capture.input_error",
    "JOINT_NAMES": "preprocess.body.kinematics",
    "Player": "export.player",
    "train": "instant_avatar.trained_avatar",
}
"""The public names, and the module of each."""


def __getattr__(name: str) -> object:
    """Load a public name at its first use (PEP 562)."""
    if name not in PUBLIC_NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(PUBLIC_NAMES[name]), name)


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(PUBLIC_NAMES)
