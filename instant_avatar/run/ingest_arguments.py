"""Arguments of ia-ingest; the text under each field is its --help."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from avatar.config import HELD_OUT_STRIDE, NOMINAL_STEPS_PER_S
from capture.input_error import InputError
from capture.live_sources import IDLE_TIMEOUT_S
from capture.source import FrameSource
from instant_avatar.cli.command_line import require_packages
from instant_avatar.cli.shared_options import (
    CaptureArguments,
    Flag,
    OptionalCount,
    OptionalFile,
    OptionalFolder,
    OptionalName,
    OptionalPixels,
    Switch,
    capture_name,
    check_output_file,
)
from instant_avatar.run.run_folder import RunFolder, is_run_report
from preprocess.capture_inputs import MAX_HEIGHT_CM, MIN_HEIGHT_CM, CaptureInputs
from preprocess.plugins import segmenter_name

PROGRAM = "ia-ingest"
"""Name of the command."""
DEFAULT_SECONDS = 60.0
"""Training time without --seconds, --steps or --realtime."""
MIN_SECONDS = 0.1
"""Least --seconds; every frame is trained on at least once in any case."""
VIEW_PORT = 8008
"""Port of the live viewer where --view names none."""


@dataclass(frozen=True, kw_only=True)
class IngestArguments(CaptureArguments):
    """Train an avatar from a video of one person while the video is being read.

    Try it:

        ia-ingest video.mp4 --out run

    `run` then holds avatar.iavatar (play it: ia-play), report.json, report.html (look at it) and
    checkpoint/. Poses and masks are found in the video by the built-in tracker (ia-track) and are
    kept in tracking/; those of another tracker are used if they are given:

        ia-ingest video.mp4 --poses poses.npz --masks masks --out run

    Masks and cameras are searched for next to the video, then next to the poses, as masks/ and
    cameras.npz; a capture folder contains everything.

    Exit codes: 0 done; 1 trained, but the avatar is not usable (verdict "failed" in the report; the
    package is written if there is anything to draw); 2 bad input; 3 disk full, device or run folder
    busy (the checkpoint is kept); 130 Ctrl-C, after checkpoint and package, or the frames that were
    tracked until then, were written.
    """

    video: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """Video file, folder of images, or capture folder; camera:0 for a camera, or the address of a
    stream, as in camera:rtsp://…"""
    tracker: OptionalName = None
    """Another installed tracker to use where no --poses are given (default: blazepose, the built-in
    one; docs/formats.md)."""
    height_cm: Annotated[float | None, arg(metavar="CM", help_behavior_hint="")] = None
    """Height of the person, barefoot. Sets the metric scale of the body, its distance and solved
    cameras, which images alone cannot determine."""
    out: OptionalFolder = None
    """Folder for the run (default: runs/NAME, named after the video or its folder)."""
    resume: Flag = False
    """Continue the run in --out: with the same video after an interruption, or with another one."""
    overwrite: Flag = False
    """Replace the run in --out, and the file that --json names. Files that ia-ingest did not write
    are kept."""
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """Training time in seconds, excluding start-up (default: 60; with --realtime the clip's
    duration)."""
    steps: OptionalCount = None
    """Number of training steps instead of --seconds, so that the result does not depend on the
    speed of the machine, but for rounding. Two cores make about 50 per second. Every frame takes
    at least one step."""
    realtime: Flag = False
    """Simulate a live camera: deliver frames at their timestamps. The avatar is ready some seconds
    after the video ends; extra --seconds continue training after the last frame."""
    live: Flag = False
    """VIDEO is a folder to which another program is still writing images; the person is tracked
    while they come, and each image is used, however late it is its turn. The run ends with a file
    named DONE in the folder, after --idle-seconds without a new image, after --seconds if they are
    given, or by Ctrl-C. A camera is live without this flag, and its images are dropped where
    tracking is too slow for them."""
    idle_seconds: float = IDLE_TIMEOUT_S
    """End the run when no new image has come into a live folder for this many seconds; also the
    limit for the first one."""
    size: OptionalPixels = None
    """Longer side of training images in pixels; never upscaled (default: 540 for 60 s, proportional
    to the square root of --seconds). The head is learnt in the video's own resolution."""
    hold_out: Annotated[int, arg(metavar="N", help_behavior_hint="(default: 10)")] = HELD_OUT_STRIDE
    """Hold out every Nth frame for evaluation; 0 trains on all frames."""
    refine_poses: Switch = True
    """Fit poses, body and focal length to the masks, and optimize the poses during training. With
    --no-refine-poses all are taken as exact."""
    refine_masks: Switch = True
    """Refine given masks if the pictures have stronger edges beside their borders."""
    force: Flag = False
    """Train even if ia-check considers poses and masks unusable."""
    view: Annotated[int | None, arg(metavar="[PORT]", help_behavior_hint="")] = None
    """Open a live viewer at http://127.0.0.1:PORT (default 8008): orbit the avatar, see body
    coverage, pause training, save a package. Requires the extra [viewer]. Ctrl-C closes it at the
    end."""
    threads: OptionalCount = None
    """Threads of the trainer (default: one per core)."""
    seed: int = 0
    """Random seed."""
    json: OptionalFile = None
    """Write a copy of report.json to this file."""

    def validate(self) -> None:
        """Check ranges, combinations and output files; an `InputError` names the option."""
        inputs = self.capture_inputs()
        if inputs.is_live:
            self._check_live_options()
        for option, value, is_valid, rule in (
            ("seconds", self.seconds, lambda s: MIN_SECONDS <= s < float("inf"),
             f"at least {MIN_SECONDS:g} ({DEFAULT_SECONDS:.0f} give a good avatar)"),
            ("steps", self.steps, lambda steps: steps >= 1, "at least 1"),
            ("size", self.size, lambda px: px >= 16, "at least 16 pixels"),
            ("threads", self.threads, lambda threads: threads >= 1, "at least 1"),
            ("idle-seconds", self.idle_seconds, lambda s: 0.0 < s < float("inf"), "positive"),
            ("height-cm", self.height_cm, lambda cm: MIN_HEIGHT_CM <= cm <= MAX_HEIGHT_CM,
             f"from {MIN_HEIGHT_CM:.0f} to {MAX_HEIGHT_CM:.0f}"),
            ("hold-out", self.hold_out, lambda n: n == 0 or n >= 2, "0, or at least 2"),
            ("seed", self.seed, lambda seed: seed >= 0, "at least 0"),
            ("view", self.view, lambda port: 0 <= port < 1 << 16, "a port from 0 to 65535"),
        ):  # fmt: skip
            if value is not None and not is_valid(value):
                raise InputError(f"--{option} is {value}, but must be {rule}.")
        if self.steps is not None and self.seconds is not None:
            raise InputError("--steps and --seconds are mutually exclusive.")
        if self.json is not None:
            read = inputs.input_paths()
            check_output_file(self.json, "--json", read, overwrite=self.may_replace_json)
        if self.view is not None:
            require_packages("viser")

    def _check_live_options(self) -> None:
        if self.realtime:
            raise InputError(
                "--realtime simulates a live camera with a recording; this source is live. Drop it."
            )
        if self.poses is not None:
            raise InputError(
                f"--poses {self.poses}: poses of a live source are tracked while its frames come, "
                "by the built-in tracker or another installed one (--tracker NAME). Leave --poses "
                "out, or record the frames and give them with their poses as a recording."
            )
        if self.masks is not None and segmenter_name(self.masks) is None:
            raise InputError(
                f"--masks {self.masks}: masks of a live source are tracked with its poses, or come "
                "from an installed segmenter (segmenter:NAME) or the images' alpha channel. Leave "
                "--masks out."
            )

    @property
    def may_replace_json(self) -> bool:
        """True if --json may replace a file: with --overwrite, or if it is a report of a run."""
        return self.overwrite or (self.json is not None and is_run_report(self.json))

    def run_folder(self) -> RunFolder:
        """Return the folder of the run."""
        own = capture_name(self.video)
        if self.capture_inputs().camera is not None:
            own = re.sub(r"\W+", "-", str(self.video)).strip("-")
        return RunFolder(path=self.out or Path("runs") / own)

    def capture_inputs(self) -> CaptureInputs:
        """Return the inputs to open."""
        return replace(
            super().capture_inputs(),
            live=self.live,
            realtime=self.realtime,
            tracker=self.tracker,
            idle_s=self.idle_seconds,
            watch_s=self.seconds if self.steps is None else self.steps / NOMINAL_STEPS_PER_S,
            refine_masks=self.refine_masks,
            height_m=None if self.height_cm is None else self.height_cm / 100.0,
        )

    def longer_side_px(self, source: FrameSource) -> int:
        """Return the longer side of images whose detail can be learned in the time, or --size."""
        minutes = self.training_seconds(source) / DEFAULT_SECONDS
        return self.size or max(256, round(540 * minutes**0.5))

    def training_seconds(self, source: FrameSource) -> float:
        """Return the training time: as given, else the clip's duration, else a minute.

        With --steps it is nominal: it sets the level of detail, not the end of training.
        """
        if self.steps is not None:
            return self.steps / NOMINAL_STEPS_PER_S
        if self.seconds is not None:
            return self.seconds
        return source.duration_s if self.realtime and source.duration_s else DEFAULT_SECONDS

    def as_json(self) -> dict[str, Any]:
        """Return the arguments as report.json stores them."""
        return {
            name: str(value) if isinstance(value, Path) else value
            for name, value in vars(self).items()
        }
