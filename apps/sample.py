"""ia-sample: films a synthetic person into a capture folder, with the truth beside it."""

import errno
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from apps.studio.writer import ShootConfig, shoot
from capture.errors import BadInput


@dataclass(frozen=True, kw_only=True)
class SampleConfig:
    """Films a synthetic person into a capture folder, with the truth beside it.

    OUT then holds video.mp4 (lossless), masks/, cameras.npz, poses.npz, dance.npz (a motion to
    drive the avatar with, never filmed) and truth/: the exact poses, and twelve never-seen poses
    with their true images. Try it:

        ia-sample demo/capture

        ia-ingest demo/capture/video.mp4 --poses demo/capture/poses.npz --out demo/run

    With --motion walkaround a phone is carried around the actor in a furnished room. Like a
    phone's video it comes without cameras: poses.npz is told in the camera of each frame, with K;
    the true cameras lie in OUT/truth/cameras.npz, to compare with or to give as --cameras.

    Exit codes: 0 done, 2 bad input, 3 disk full, 130 Ctrl-C. The folder is written whole or not
    at all.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder to write."""
    shoot: Annotated[ShootConfig, tyro.conf.arg(name="")] = field(default_factory=ShootConfig)
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace a capture that is already there."""


def main() -> None:
    """The command."""
    config = tyro.cli(SampleConfig, prog="ia-sample")
    console = Console(stderr=True)
    try:
        _shoot_with_bar(config, console)
    except BadInput as error:
        console.print(f"[red]ia-sample:[/] {error}", highlight=False)
        sys.exit(2)
    except OSError as error:
        console.print(f"[red]ia-sample:[/] {error}. Nothing was left behind.", highlight=False)
        sys.exit(3 if error.errno in (errno.ENOSPC, errno.EDQUOT) else 2)
    except KeyboardInterrupt:
        console.print("[yellow]Stopped; nothing was left behind.[/]")
        sys.exit(130)
    out = config.out
    console.print(f"Filmed {config.shoot.frames} frames into [bold]{out}[/]. Next:")
    console.print(f"  ia-ingest {out}/video.mp4 --poses {out}/poses.npz", highlight=False)


def _shoot_with_bar(config: SampleConfig, console: Console) -> None:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("Dressing the actor", total=None)

        def advance(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, description="Filming")

        shoot(config.out, config.shoot, advance, overwrite=config.overwrite)


if __name__ == "__main__":
    main()
