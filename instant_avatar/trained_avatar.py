"""Training from Python: a video in, a package and its report out."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console as RichConsole

from capture.input_error import InputError
from instant_avatar.cli.command_line import INTERRUPTED, NO_AVATAR, CommandExit
from instant_avatar.cli.console import Console
from instant_avatar.ingest import ingest
from instant_avatar.run.ingest_arguments import IngestArguments

if TYPE_CHECKING:  # it imports torch
    from instant_avatar.run.session_events import EventReader


@dataclass(frozen=True, kw_only=True)
class TrainedAvatar:
    """What `train` leaves in its folder.

    Attributes:
        folder: The run folder: package, report.json, report.html, checkpoint.
        package: The avatar, for `Player.load`; None if training left nothing to draw.
        report: report.json (docs/report.md).
    """

    folder: Path
    package: Path | None
    report: dict[str, Any]

    @property
    def verdict(self) -> str | None:
        """Verdict on the avatar from all sides: sharp, soft, blurred or failed."""
        return self.report["verdict"]


def train(
    video: str | Path,
    out: str | Path,
    *,
    poses: str | Path | None = None,
    masks: str | Path | None = None,
    cameras: str | Path | None = None,
    seconds: float | None = None,
    steps: int | None = None,
    quiet: bool = False,
    readers: Sequence["EventReader"] = (),
    **options: Any,
) -> TrainedAvatar:
    """Train an avatar from a video of one person, as `ia-ingest` does.

    Args:
        video: Video file, folder of images, or capture folder.
        out: Folder for the run; an earlier run needs `resume=True` or `overwrite=True`.
        poses: SMPL poses of any tracker (docs/formats.md); None: tracked in the video.
        masks: Masks of the person; None: tracked with the poses.
        cameras: Camera file, "static" or "solve" (docs/cameras.md).
        seconds: Training time (default: 60).
        steps: Number of training steps instead of `seconds`.
        quiet: Print no progress on stderr.
        readers: Functions that receive every event of the run (`session_events`).
        **options: Further options of `ia-ingest`, with underscores: `height_cm`, `size`, `seed`, …

    Returns:
        The avatar, also one that is not usable: look at its `verdict`.

    Raises:
        InputError: If the input cannot be used; nothing was written then.
        OSError: If the disk is full; the newest checkpoint is kept.
        KeyboardInterrupt: At Ctrl-C, after checkpoint and package were written.
    """
    arguments = IngestArguments(
        video=Path(video), out=Path(out), poses=_path(poses), masks=_path(masks),
        cameras=None if cameras is None else str(cameras), seconds=seconds, steps=steps,
        **options,
    )  # fmt: skip
    console = Console(RichConsole(stderr=True, quiet=True) if quiet else None)
    try:
        code = ingest(arguments, console, readers)
    except CommandExit as ended:
        code = ended.code
        if code not in (NO_AVATAR, INTERRUPTED):
            raise InputError(str(ended)) from ended
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    run = arguments.run_folder()
    return TrainedAvatar(
        folder=run.path,
        package=run.package if run.package.is_file() else None,
        report=json.loads(run.report_json.read_text(encoding="utf-8")),
    )


def _path(name: str | Path | None) -> Path | None:
    return None if name is None else Path(name)
