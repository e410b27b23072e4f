"""What ia-ingest can be told; the text under each field is its --help."""

import importlib.util
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from apps.cli.output_paths import check_output_file
from apps.run.run_folder import RunFolder, is_run_report
from apps.run.solver_process import SolveJob
from avatar.config import HELD_OUT_STRIDE, NOMINAL_STEPS_PER_S
from capture.input_error import InputError
from capture.live.camera_device import camera_address
from capture.live.watched_image_folder import IDLE_TIMEOUT_S
from preprocess.alignment.mask_alignment import MAX_HEIGHT_CM, MIN_HEIGHT_CM
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.masks.mask_origin import segmenter_name
from preprocess.open_capture import open_capture

REFERENCE_LONGER_SIDE_PX = 540
"""Longer side of the pictures that a minute is enough for."""

DEFAULT_SECONDS = 60.0

MIN_SECONDS = 0.1
"""A few steps; every frame is trained on once in any case."""

VIEW_PORT = 8008
"""Of the page that --view opens."""

Flag = Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")]


@dataclass(frozen=True, kw_only=True)
class IngestArguments:
    """Learns an avatar from a video of one person while the video is read.

    Try it:

        ia-ingest video.mp4 --poses poses.npz --out run

    `run` then holds avatar.iavatar (play it: ia-play), report.json, report.html (look at it) and
    checkpoint/. Masks and cameras are looked for beside the video, then beside the poses, as
    masks/ and cameras.npz; of a capture folder everything is found inside.

    Exit codes: 0 done; 1 learnt, but the result is no usable avatar (verdict "failed"
    in the report; the package is written all the same if there is anything to draw); 2 bad input;
    3 full disk, busy device or busy run folder, the checkpoint is kept; 130 Ctrl-C, after
    checkpoint and package were written.
    """

    video: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """Video file, folder of pictures, or capture folder; camera:0 for a camera, or the address of
    a stream, as in camera:rtsp://…"""
    poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """SMPL poses: an .npz with global_orient, body_pose, transl (or poses, trans), or what
    4D-Humans, WHAM, VIBE, GVHMR, TRAM, PromptHMR, ROMP, BEV or EasyMocap wrote (a file, or a folder
    of them); see docs/formats.md. Pickles are read without executing them."""
    person: Annotated[str | None, arg(metavar="ID", help_behavior_hint="")] = None
    """Whose poses, by the file's own number; without it whoever has most."""
    masks: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Masks, one a frame, 255 where the person is: a folder of pictures, a video, an .npz, or
    COCO's run-length codes. Without any they are estimated from the pictures and the poses
    (segmenter:grabcut); segmenter:NAME takes another that is installed."""
    mask_invert: Flag = False
    """The person is dark in the masks. Without either flag that is found out."""
    no_mask_invert: Flag = False
    """The person is bright in the masks."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """A cameras.npz (intrinsic, extrinsic: one, or one a frame), a COLMAP model, a transforms.json,
    Record3D's or Polycam's export; `static`: never moved, and its focal length is unknown; or
    `solve`: the camera moves, and where it was is found from the pictures (a minute or two, with
    pycolmap; docs/cameras.md). Poses are then taken to be in the camera of each frame."""
    height_cm: Annotated[float | None, arg(metavar="CM", help_behavior_hint="")] = None
    """How tall the person is, barefoot. Pictures alone cannot tell a tall person from a near one:
    body, distances and solved cameras take their size from it."""
    body: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Your own SMPL body, .npz or .pkl (nothing in it is executed); else the embedded body."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder for the run; without it runs/NAME, after the video."""
    resume: Flag = False
    """Go on with the run in --out: with the same video after an interruption, or with another."""
    overwrite: Flag = False
    """Replace the run in --out, and the file that --json names. Files that ia-ingest did not write
    stay."""
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """How long you will wait: seconds of training, after start-up. Without it 60; with --realtime
    as long as the clip lasts."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Number of training steps instead of --seconds: the result then does not depend on how fast
    the machine is. Two cores make about 50 a second. Every frame takes at least one step."""
    realtime: Flag = False
    """Play the video as if it were being filmed now: each frame comes at its own time, and the
    avatar is ready when the video ends. More --seconds polish it after the last frame."""
    live: Flag = False
    """VIDEO is a folder that another program is still writing pictures to, while a tracker writes
    the poses (the .npz again and again, or a .jsonl, a frame a line) and masks of the same names as
    the pictures come into --masks. It ends with a file named DONE in the folder, when nothing new
    has come for --idle-seconds, after --seconds, or by Ctrl-C. A camera is live without it."""
    idle_seconds: float = IDLE_TIMEOUT_S
    """How long a live source may bring nothing new, and its first picture and pose may take."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Longer side of the pictures in pixels; they are never enlarged. Without it, what can
    be learnt in --seconds: 540 in a minute, twice as many in four."""
    frames: str = "::"
    """Which frames, START:STOP:STEP, counted from 0."""
    hold_out: Annotated[int, arg(metavar="N", help_behavior_hint="(default: 10)")] = HELD_OUT_STRIDE
    """Every Nth frame is kept for scores and never learnt from; 0 learns from all."""
    refine_poses: Annotated[bool, arg(help_behavior_hint="")] = True
    """Correct the poses while the avatar is learnt: a tracker's jitter costs more than anything."""
    force: Flag = False
    """Begin even if poses and masks disagree so much that ia-check calls them unusable."""
    view: Annotated[int | None, arg(metavar="[PORT]", help_behavior_hint="")] = None
    """Watch it learn on a page of this machine, http://127.0.0.1:PORT (8008 if PORT is left out):
    turn the avatar, see what the camera has not seen yet, pause, save a package now. Needs viser:
    pip install 'instant-avatar-stream[viewer]'. Ctrl-C closes the page in the end."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto is the CPU. There are no CUDA kernels yet: cuda runs the plain-torch
    reference, which is slower."""
    threads: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Threads of the trainer; without it one for each core."""
    seed: int = 0
    """Of everything random."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write a copy of report.json to this file."""

    def validate(self) -> None:
        """Refuses numbers out of their range.

        Raises:
            InputError: Naming the option.
        """
        if self.seconds is not None and not MIN_SECONDS <= self.seconds < float("inf"):
            raise InputError(
                f"--seconds is {self.seconds}; at least {MIN_SECONDS:g} was expected "
                f"({DEFAULT_SECONDS:.0f} make a good avatar)."
            )
        if self.steps is not None and self.steps < 1:
            raise InputError(f"--steps is {self.steps}; at least 1 was expected.")
        if self.steps is not None and self.seconds is not None:
            raise InputError("--steps and --seconds both say when training ends: give one of them.")
        if self.size is not None and self.size < 16:
            raise InputError(f"--size is {self.size}; at least 16 pixels were expected.")
        if self.threads is not None and self.threads < 1:
            raise InputError(f"--threads is {self.threads}; at least 1 was expected.")
        if not 0.0 < self.idle_seconds < float("inf"):
            raise InputError(
                f"--idle-seconds is {self.idle_seconds}; a positive number was expected."
            )
        if self.realtime and (self.live or camera_address(self.video) is not None):
            raise InputError(
                "--realtime plays a recording; a live source has its own pace. Drop it."
            )
        if self.height_cm is not None and not MIN_HEIGHT_CM <= self.height_cm <= MAX_HEIGHT_CM:
            raise InputError(
                f"--height-cm is {self.height_cm}; {MIN_HEIGHT_CM:.0f} to {MAX_HEIGHT_CM:.0f} was expected."
            )
        if self.hold_out < 0 or self.hold_out == 1:
            raise InputError(f"--hold-out is {self.hold_out}; 0, or 2 and more, was expected.")
        if self.seed < 0:
            raise InputError(f"--seed is {self.seed}; 0 or more was expected.")
        if self.json is not None:
            check_output_file(
                self.json,
                "--json",
                self.capture_inputs().input_paths(),
                overwrite=self.may_replace_json,
            )
        mask_inversion(person_dark=self.mask_invert, person_bright=self.no_mask_invert)
        if self.view is not None and not 0 <= self.view < 1 << 16:
            raise InputError(f"--view is {self.view}; a port from 0 to 65535 was expected.")
        if self.view is not None and importlib.util.find_spec("viser") is None:
            raise InputError(
                "--view shows a page made with viser, which is not installed. Install it with: "
                "pip install 'instant-avatar-stream[viewer]' (or: pip install viser). Or leave "
                "--view out: report.html shows the result afterwards."
            )

    @property
    def may_replace_json(self) -> bool:
        """Whether --json may replace the file there: as told, or because it is a report of ours."""
        return self.overwrite or (self.json is not None and is_run_report(self.json))

    def run_folder(self) -> RunFolder:
        """Where the run lies."""
        name = self.video.resolve()
        own = name.name if name.is_dir() else name.stem
        if camera_address(self.video) is not None:
            own = re.sub(r"\W+", "-", str(self.video)).strip("-")
        return RunFolder(path=self.out or Path("runs") / own)

    def capture_inputs(self) -> CaptureInputs:
        """What is to be opened."""
        return CaptureInputs(
            video=self.video,
            poses=self.poses,
            masks=self.masks,
            cameras=self.cameras,
            body=self.body,
            frames=parse_frame_range(self.frames),
            invert_masks=mask_inversion(
                person_dark=self.mask_invert, person_bright=self.no_mask_invert
            ),
            live=self.live,
            person=self.person,
            idle_s=self.idle_seconds,
            height_m=None if self.height_cm is None else self.height_cm / 100.0,
        )

    def solve_job(self, recording: Capture) -> SolveJob | None:
        """What is to be solved, if cameras are; by the parts that were found."""
        if self.cameras != "solve":
            return None
        found = recording.paths
        named = self.capture_inputs()
        if segmenter_name(named.masks) is None:
            named = replace(named, masks=found.masks)
        named = replace(named, video=found.video, poses=found.poses)
        return SolveJob(paths=named, seed=self.seed, threads=self.threads or os.cpu_count() or 1)

    def open_capture(self) -> Capture:
        """Opens what the arguments name."""
        run = self.run_folder()
        goes_on = self.resume and run.has_checkpoint() and run.body_file.is_file()
        recording = open_capture(
            self.capture_inputs(), avatar_body=run.body_file if goes_on else None
        )
        size_px = self.size or trainable_longer_side_px(self.training_seconds(recording))
        recording = replace(recording, size_px=size_px)
        return recording.in_real_time() if self.realtime else recording

    def training_seconds(self, recording: Capture) -> float:
        """Seconds of training: as given, else as long as the clip lasts, else a minute.

        With --steps they are nominal: they decide the detail, not when training ends.
        """
        if self.steps is not None:
            return self.steps / NOMINAL_STEPS_PER_S
        if self.seconds is not None:
            return self.seconds
        duration_s = recording.source.duration_s
        return duration_s if self.realtime and duration_s else DEFAULT_SECONDS

    def as_json(self) -> dict[str, Any]:
        """The arguments as report.json keeps them."""
        return {
            name: str(value) if isinstance(value, Path) else value
            for name, value in vars(self).items()
        }


def parse_frame_range(text: str) -> slice | None:
    """START:STOP:STEP as a slice; None for all frames.

    Raises:
        InputError: If it is something else.
    """
    if not re.fullmatch(r"\d*(:\d*){0,2}", text) or ":" not in text:
        raise InputError(
            f"--frames is {text!r}; expected START:STOP:STEP counted from 0, as in 0:120:2 or 30:."
        )
    parts = [int(part) if part else None for part in text.split(":")]
    return None if not any(part is not None for part in parts) else slice(*parts)


def mask_inversion(*, person_dark: bool, person_bright: bool) -> bool | None:
    """Whether masks are to be turned; None if that is to be found out.

    Args:
        dark: Whether --mask-invert was given: the person is dark.
        bright: Whether --no-mask-invert was given.

    Raises:
        InputError: If both were.
    """
    if person_dark and person_bright:
        raise InputError("--mask-invert and --no-mask-invert contradict; give one of them.")
    return person_dark if person_dark or person_bright else None


def trainable_longer_side_px(seconds: float) -> int:
    """Longer side, in pixels, of pictures whose detail can be learnt in so many seconds."""
    return max(256, round(REFERENCE_LONGER_SIDE_PX * (seconds / 60.0) ** 0.5))
