"""All that is known about a video before its first frame is read, checked together."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capture.camera import Camera
from capture.errors import InputError
from capture.frame import Frame
from capture.pace import PacingClock
from capture.playback import RealtimePlayback
from capture.source import FrameSource
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.capture_folder import CapturePaths
from preprocess.doctor.claim import CaptureGeometry
from preprocess.fit.growing import LiveAlignment
from preprocess.fit.refit import BodyPlacement
from preprocess.live import LiveInputs
from preprocess.masks.files import Masks
from preprocess.masks.segmenter import Segmenter
from preprocess.observation import Observation
from preprocess.observe import DroppedFrame, observation_builder
from preprocess.pose import Motion


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """A video of one person, with everything that belongs to it.

    Attributes:
        paths: Where its parts lie.
        source: The frames.
        motion: The poses.
        masks: The masks; None if the pictures' alpha channel is the mask, `segment` estimates them,
            or they come with a live source.
        cameras: The cameras, of the frames' size.
        shaped: The person's body.
        size_px: Longer side that training sees; None for the frames' own.
        notes: What a user should know about how the parts were read.
        live: Poses and masks of a live source, which come while it runs; `motion` is what had come
            when it was opened.
        segment: What estimates the masks, if nothing holds them.
        solved: What the report says of cameras that were solved.
        refit: How the poses were fitted to the masks, if they were made for another body.
        growing_fit: The same of a live source, which goes on while its frames come.
    """

    paths: CapturePaths
    source: FrameSource
    motion: Motion
    masks: Masks | None
    cameras: CameraTrack
    shaped: ShapedBody
    size_px: int | None
    notes: tuple[str, ...]
    live: LiveInputs | None = None
    segment: Segmenter | None = None
    camera_report: dict[str, Any] | None = None
    refit: BodyPlacement | None = None
    live_fit: LiveAlignment | None = None

    def check(self) -> None:
        """Whether the parts fit together; no frame is read.

        Raises:
            InputError: If they do not.
        """
        self.observation_builder()
        self.pixel_footprint_m()

    def observations(self) -> Iterator[Observation | DroppedFrame]:
        """The frames with pose, mask and camera, in order, lazily; every call starts anew."""
        return map(self.observation_builder(), self.source.frames())

    def observation_builder(self) -> Callable[[Frame], Observation | DroppedFrame]:
        """What joins a frame with its pose, mask and camera."""
        if self.live is not None:
            return self.live.observation_builder(
                self.source, self.cameras, self.size_px, self.segment, self.live_fit
            )
        return observation_builder(
            self.source, self.motion, self.masks, self.cameras, size_px=self.size_px,
            segment=self.segment,
        )  # fmt: skip

    def mask_report(self) -> dict[str, str | float | None]:
        """Where the masks come from, and how well estimated ones agree with the posed body."""
        if self.segment is not None:
            agreement = getattr(self.segment, "agreement", None)
            name = getattr(self.segment, "name", type(self.segment).__name__)
            return {"masks": f"estimated by {name}", "mask_agreement": agreement}
        source = "alpha channel" if self.paths.masks is None else self.paths.masks.name
        return {"masks": source, "mask_agreement": None}

    def final_notes(self) -> Iterator[str]:
        """What could not be said before the frames came."""
        growing = self.live_fit
        if growing is not None and growing.placement is not None:
            yield f"{growing.placement.describe()} (By the first {growing.frame_count} frames.)"

    def body_fit_report(self) -> dict[str, float | bool] | None:
        """How the poses were fitted to the body that is used; None if that was not needed."""
        growing = self.live_fit
        refit = self.refit if growing is None else growing.placement
        if refit is None:
            return None
        told = refit.as_json()
        return told if growing is None else {**told, "frames": growing.frame_count}

    def camera_of_pose(self, row: int) -> Camera:
        """The camera that sees one of the poses."""
        claim = CaptureGeometry.of(self.motion, self.cameras, self.source)
        return self.cameras[int(claim.camera_rows()[row])]

    def in_real_time(self) -> "Capture":
        """The same, its frames coming at their own times."""
        return replace(self, source=RealtimePlayback(self.source, PacingClock()))

    def pixel_footprint_m(self) -> float:
        """What one pixel covers on the body: the dial of the field's resolution.

        Raises:
            InputError: If the person is behind the camera.
        """
        claim = CaptureGeometry.of(self.motion, self.cameras, self.source)
        valid = self.motion.valid
        pelves = self.shaped.joints[0] + self.motion.root_translations[valid]
        forward = claim.extrinsics[claim.camera_rows()[valid], 2]  # of the camera that sees each
        depth = float(np.median((pelves * forward[:, :3]).sum(axis=1) + forward[:, 3]))
        camera = self.cameras[0]
        if depth <= 0.0:
            raise InputError(
                f"The person is at the camera or behind it (depth {depth:.2f} m); poses were "
                "expected in the camera's world, in metres, with OpenCV axes (x right, y down, "
                "z forward). Do poses and cameras come from the same run? Poses in a world need "
                "the cameras of that world; without them, and with --cameras solve, poses must be "
                "in each frame's own camera."
            )
        longer = max(camera.size_px)
        shrinking = min(1.0, (self.size_px or longer) / longer)
        return depth / (max(camera.focal_px) * shrinking)
