"""ia-track: find poses, masks and camera of the person in a video, and film them for checking."""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from capture.atomic_files import OutputFileList, write_text_atomically
from capture.input_error import InputError, quote_command
from capture.live_sources import camera_address
from instant_avatar.cli.command_line import DONE, INTERRUPTED, run_main, stop_on_interrupt
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import (
    Flag,
    OptionalCameras,
    OptionalCount,
    OptionalFile,
    OptionalFolder,
    OptionalName,
    Switch,
    capture_name,
    check_output_file,
    check_output_folder,
    format_frame_range,
    open_recording,
    option_words,
    parse_frame_range,
    unused_path,
)
from instant_avatar.run.run_folder import RunFolder, claim_folder, listing_outputs
from preprocess.capture_inputs import CaptureInputs

PROGRAM = "ia-track"


@dataclass(frozen=True, kw_only=True)
class TrackArguments:
    """Find poses, masks and camera of the person in a video, and grade them.

    Neural networks (BlazePose) find key points and a mask in each frame; then one body, its poses
    and the focal length are fitted to all of them. It needs about 60 ms per frame on one core and
    no graphics card. ia-ingest does the same by itself where no --poses are given; run ia-track to
    look at the poses first, or to use them elsewhere. Try it:

        ia-track video.mp4 --out tracked/poses.npz

        ia-ingest video.mp4 --poses tracked/poses.npz

    `tracked` then holds poses.npz (SMPL's keys: global_orient, body_pose, transl; and K, the key
    points, and the body's proportions. The angles belong to the embedded body, model "body24", not
    to SMPL's shape), masks/, skeleton.mp4 (look at it) and grade.json.

    It works best on one person, from head to feet in the picture, in a video of a camera that
    stands still. Hidden limbs are guessed, and fast ones are often wrong.

    Exit codes: 0 the poses are good enough for an avatar; 1 they are not, but were written; 2 bad
    input, or no person was found; 3 disk full; 130 Ctrl-C, after what was found so far was written.
    """

    video: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """Video file, folder of images, or capture folder."""
    out: OptionalFile = None
    """Poses to write, .npz; the rest is written beside it (default: runs/NAME-tracked/poses.npz,
    named after the video)."""
    person: OptionalCount = None
    """Which person, counted from left to right from 1 in the first frame with that many persons
    (default: the largest)."""
    tracker: OptionalName = None
    """Another installed tracker to use (default: blazepose, the built-in one; docs/formats.md)."""
    masks: OptionalFolder = None
    """Masks to use instead of tracked ones, as ia-ingest takes them."""
    cameras: OptionalCameras = None
    """Cameras, as ia-ingest takes them (default: a camera that stands still; its focal length is
    fitted)."""
    body: OptionalFile = None
    """Your own SMPL body; the poses are then SMPL's (default: the embedded body)."""
    frames: str = "::"
    """Frames to use: START:STOP:STEP, counted from 0 (default: all; of a long video every nth, 600
    at most)."""
    rotate: Literal[0, 90, 180, 270] = 0
    """Turn each frame clockwise by this many degrees, where the video lies on its side or upside
    down; masks and cameras that are given must be those of the turned frames."""
    film: Switch = True
    """Draw skeleton.mp4."""
    overwrite: Flag = False
    """Replace what ia-track wrote there before. Files that it did not write are kept."""

    def poses_path(self) -> Path:
        """Return the path of the poses."""
        return self.out or Path("runs") / f"{capture_name(self.video)}-tracked" / "poses.npz"

    def capture_inputs(self) -> CaptureInputs:
        """Return the inputs to open; refuse those that cannot be tracked."""
        if camera_address(self.video) is not None:
            raise InputError(f"{self.video} is a camera, but ia-track needs a recording.")
        if self.person is not None and self.person < 1:
            raise InputError(f"--person is {self.person}, but must be at least 1 (the leftmost).")
        if self.cameras == "solve":
            raise InputError(
                "--cameras solve needs poses first. Track with --cameras static, then run "
                "ia-ingest with --poses and --cameras solve."
            )
        return CaptureInputs(
            video=self.video,
            masks=self.masks,
            cameras=self.cameras,
            body=self.body,
            frames=parse_frame_range(self.frames),
            person=None if self.person is None else str(self.person),
            tracker=self.tracker,
            rotate=self.rotate,
        )

    def check_outputs(self) -> None:
        """Refuse outputs that cannot be written, or would replace the files of others."""
        poses, inputs = self.poses_path(), self.capture_inputs()
        folder, masks = poses.parent, poses.parent / "masks"
        if poses.suffix.lower() != ".npz":
            raise InputError(f"--out is {poses}, but must end in .npz.")
        free = unused_path(Path(os.path.abspath(folder)).with_name("tracked")) / "poses.npz"
        free = free if folder.is_absolute() else Path(os.path.relpath(free))
        advice = f"choose another folder: --out {quote_command(free)}"
        if RunFolder(path=folder).has_checkpoint():
            raise InputError(f"{folder} holds a run of ia-ingest; {advice}")
        written = [poses, self.grade_path(), *([self.film_path()] if self.film else [])]
        for path in filter(os.path.lexists, written):
            if path.is_file() and not OutputFileList(folder).owns(path.name):
                raise InputError(
                    f"{path} was not written by ia-track and would be replaced. Move it, or "
                    f"{advice}"
                )
            if not self.overwrite:
                raise InputError(
                    f"{path} already exists. Pass --overwrite to replace what ia-track wrote "
                    f"there, or {advice}"
                )
        own = {os.path.realpath(each) for each in (*written, masks)}
        read = [each for each in inputs.input_paths() if os.path.realpath(each) not in own]
        for path in written:
            check_output_file(path, "--out", read, overwrite=True, below=False)
        from instant_avatar.run.person_tracking import masks_to_use

        if masks_to_use(inputs, masks) is None:
            check_output_folder(masks, "--out")

    def grade_path(self) -> Path:
        """Return the path of the grades."""
        return self.poses_path().with_name("grade.json")

    def film_path(self) -> Path:
        """Return the path of the film."""
        return self.poses_path().with_name("skeleton.mp4")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(PROGRAM, TrackArguments, track, argv)


def next_command(arguments: TrackArguments, frames: slice | None) -> list[str]:
    """Return the command that trains on what was tracked in some frames."""
    named = {
        "poses": arguments.poses_path(), "masks": arguments.masks, "cameras": arguments.cameras,
        "body": arguments.body, "rotate": arguments.rotate or None,
        "frames": None if frames is None else format_frame_range(frames),
    }  # fmt: skip
    return ["ia-ingest", str(arguments.video), *option_words(named)]


@contextmanager
def claim_outputs(folder: Path, console: Console) -> Iterator[None]:
    """Make and lock a folder during a block, in which the files of ia-track are listed."""
    with claim_folder(folder, console), listing_outputs(folder):
        yield


def track(arguments: TrackArguments, console: Console) -> int:
    """Track the person, and write poses, masks, film and grades."""
    inputs, poses = arguments.capture_inputs(), arguments.poses_path()
    open_recording(inputs, console)  # before code is loaded that takes a second
    from instant_avatar.run.person_tracking import print_doubts, track_person
    from instant_avatar.tracked_video import write_tracked_video

    arguments.check_outputs()
    saving = "writing what was found so far"
    with claim_outputs(poses.parent, console), stop_on_interrupt(console, saving) as stop:
        tracking = track_person(inputs, poses, console, stop=stop)
        text = json.dumps(tracking.grade.as_json(), indent=1) + "\n"
        write_text_atomically(arguments.grade_path(), text)
        console.print_artifact("poses", poses)
        if arguments.film and not stop.is_set():
            with console.status("drawing the film"):
                video = arguments.film_path()
                write_tracked_video(video, tracking.capture(), tracking.grade.doubts)
            console.print_artifact("look at it", arguments.film_path())
    print_doubts(tracking.grade, console)
    console.info(tracking.grade.describe())
    if tracking.grade.is_good_enough:
        console.info("Next:")
        command = next_command(arguments, tracking.imported.inputs.frames)
        console.info(f"  {quote_command(*command)}")
    if tracking.interrupted:
        return INTERRUPTED
    # written, but not good enough for an avatar
    return DONE if tracking.grade.is_good_enough else 1


if __name__ == "__main__":
    sys.exit(main())
