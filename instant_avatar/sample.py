"""ia-sample: film a synthetic actor into a capture folder with ground truth."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from capture.input_error import counted, quote_command
from instant_avatar.cli.command_line import DONE, run_main
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import Flag, check_output_folder
from instant_avatar.studio.shoot_config import ShootConfig


@dataclass(frozen=True, kw_only=True)
class SampleArguments:
    """Film a synthetic actor into a capture folder with ground truth.

    OUT then holds video.mp4 (lossless FFV1: VLC, mpv and ffmpeg play it), preview.mp4 (the same
    video for browsers and phones), masks/, cameras.npz, poses.npz, dance.npz (a novel motion to
    drive the avatar with) and truth/: the exact poses, and twelve novel poses with images. Try it:

        ia-sample demo/capture

        ia-ingest demo/capture/video.mp4 --poses demo/capture/poses.npz

    With --motion walkaround a phone is carried around the actor in a furnished room. Like a phone
    video it comes without cameras: poses.npz is relative to the camera of each frame, with K; the
    true cameras are in OUT/truth/cameras.npz, for comparison or for --cameras.

    With --like-a-phone everything is a little wrong, as in reality. OUT/truth then holds the exact
    body, poses, cameras and masks; the options --body, --poses, --cameras and --masks of ia-ingest
    take them.

    Exit codes: 0 done, 2 bad input, 3 disk full, 130 Ctrl-C. The folder is written whole or not at
    all.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder to write."""
    shoot: Annotated[ShootConfig, tyro.conf.arg(name="")] = field(default_factory=ShootConfig)
    overwrite: Flag = False
    """Replace an existing capture."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main("ia-sample", SampleArguments, _film, argv)


def _film(config: SampleArguments, console: Console) -> int:
    try:
        _film_with_progress(config, console)
    except (OSError, KeyboardInterrupt) as error:
        error.add_note("Nothing was written.")
        raise
    video, poses = (quote_command(config.out / name) for name in ("video.mp4", "poses.npz"))
    console.info(f"Filmed {counted(config.shoot.frames, 'frame')} into {config.out}.")
    if not config.shoot.like_a_phone:
        console.info(f"Preview for a browser: {config.out / 'preview.mp4'}.")
    console.info("Next:")
    console.info(f"  ia-ingest {video} --poses {poses}")
    return DONE


def _film_with_progress(config: SampleArguments, console: Console) -> None:
    from instant_avatar.studio.shoot import film_capture

    config.shoot.validate()
    check_output_folder(config.out, "OUT")
    with console.progress("filming", 1.0) as bar:

        def advance(done: int, total: int) -> None:
            bar.update(done / total, f"{done}/{total} frames")

        bar.update(0.0, "dressing the actor")
        film_capture(config.out, config.shoot, advance, overwrite=config.overwrite)


if __name__ == "__main__":
    sys.exit(main())
