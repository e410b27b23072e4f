"""ia-export: what a run has learnt so far, as a file that others can use."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from tyro.conf import Positional, arg

from apps.console import Console
from apps.exit_codes import DONE, NO_PACKAGE, Stop, exit_code
from apps.novel import novel_motion
from apps.run_folder import RunFolder
from capture.camera import Camera
from capture.errors import BadInput
from preprocess.pose import BodyPose

if TYPE_CHECKING:  # torch is loaded after --help has been answered
    from avatar.rig import Rig

VIEWS = 4
VIEW_PX = 256
AWAY = 3.5
"""How far the camera stands, in heights of the person."""
SHARE = 0.8
"""Of the picture's height, how much the person takes."""


@dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Makes an avatar's package from a run's newest checkpoint, at any second of the run.

    Try it, while ia-ingest is still learning or after it was killed:

        ia-export run --out now.iavatar

        ia-play now.iavatar --poses dance.npz

    The run goes on undisturbed; nothing in its folder is touched unless --out names it.

    Exit codes: 0 done; 1 too blurred for a package so far; 2 bad input; 3 disk full; 130 Ctrl-C.
    """

    run: Positional[Path]
    """Folder that ia-ingest wrote (--out), with a checkpoint/ in it."""
    to: Literal["iavatar"] = "iavatar"
    """Format: the package that ia-play plays."""
    out: Annotated[Path, arg(metavar="FILE", help_behavior_hint="(required)")]
    """File to write; it appears whole or not at all."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    given = tyro.cli(ExportArguments, prog="ia-export", args=arguments)
    return exit_code("ia-export", lambda: export(given, Console()))


def export(given: ExportArguments, console: Console) -> int:
    """Does what the arguments say.

    Raises:
        BadInput: If there is no checkpoint that can be read, or no folder to write to.
        OSError: If the disk is full.
        Stop: If the avatar is too blurred for a package.
    """
    run = RunFolder(path=given.run)
    if not run.has_checkpoint():
        raise BadInput(
            f"There is no checkpoint in {run.checkpoint}; a folder that ia-ingest wrote was "
            "expected. It writes the first one five seconds after the first frame."
        )
    if given.out.suffix != ".iavatar":
        raise BadInput(f"--out is {given.out}; a name that ends in .iavatar was expected.")
    if not given.out.resolve().parent.is_dir():
        raise BadInput(f"--out: there is no folder {given.out.resolve().parent}. Make it first.")
    with console.waiting("loading the checkpoint"):
        import torch

        from apps.snapshot import snapshot
        from avatar import checkpoint

        trainer, _ = checkpoint.load(run.checkpoint, torch.device("cpu"))
    with console.waiting("baking the avatar and checking its player"):
        taken = snapshot(trainer, given.out, views(trainer.avatar.rig), mark=None)
    if taken.exported is None:
        raise Stop(taken.refused or "nothing was written.", NO_PACKAGE)
    for warning in taken.exported.warnings:
        console.warn(warning)
    console.say(f"As learnt from {trainer.frames_seen} frames in {trainer.wall_seconds:.1f} s.")
    console.made("package", given.out)
    return DONE


def views(rig: "Rig") -> list[tuple[BodyPose, Camera]]:
    """Poses of a little motion, each seen from the front: a checkpoint holds no frames."""
    motion = novel_motion(frames=VIEWS)
    low, high = rig.seeds.min(axis=0).astype(float), rig.seeds.max(axis=0).astype(float)
    distance = AWAY * (high[1] - low[1])
    focal = SHARE * VIEW_PX * AWAY
    axes = np.diag([1.0, -1.0, -1.0])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = axes
    camera_from_world[:3, 3] = [0.0, 0.0, distance] - axes @ (0.5 * (low + high))
    camera = Camera(
        focal_px=(focal, focal),
        center_px=(VIEW_PX / 2, VIEW_PX / 2),
        size_px=(VIEW_PX, VIEW_PX),
        camera_from_world=camera_from_world,
    )
    return [(motion[row], camera) for row in range(VIEWS)]


if __name__ == "__main__":
    sys.exit(main())
