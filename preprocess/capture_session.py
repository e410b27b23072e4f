"""A capture: the inputs of the user, and everything opened and aligned before its first frame."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capture.camera import Camera
from capture.input_error import InputError
from capture.live_sources import IDLE_TIMEOUT_S, camera_address
from capture.source import Frame, FrameSource, PacingClock, RealtimePlayback
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.mask_alignment import BodyPlacement
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack
from preprocess.capture_paths import CapturePaths, find_parts
from preprocess.fitting.capture_fit import CaptureFit
from preprocess.masks.mask_files import Masks
from preprocess.masks.mask_refinement import GivenMaskRefiner
from preprocess.observation import DroppedFrame, Observation, observation_builder
from preprocess.plugins import Segmenter, segmenter_name
from preprocess.tracked_stream import LiveTracking


@dataclass(frozen=True, kw_only=True)
class CaptureInputs:
    """The inputs that the user named; the rest is looked for (see `find_capture_paths`).

    Attributes:
        video: Video file, folder of images, or capture folder.
        cameras: A file, "static", "solve" (poses are then in the camera of each frame, and so is
            all the rest until cameras were solved), or None.
        body: A body file; None for the embedded body.
        invert_masks: Whether the person is dark in the masks; None finds out.
        live: Whether `video` is a folder that grows; a camera is live without it.
        person: Whose poses, where the file holds several people's; None for the longest track.
        idle_s: Longest time without a new image from a live source, seconds.
        watch_s: Time after which new images in a live folder are not waited for; None: no limit.
        height_m: Height of the person; None if only the poses tell.
        tracker: Name of the tracker that finds poses where none are given; None: the built-in one.
        refine_masks: Whether given masks are refined where their borders miss the images' edges.
        rotate: Degrees by which frames are turned clockwise; masks, poses and cameras are those of
            turned frames.
        transposed: Whether the video's width and height are exchanged before masks and cameras are
            compared with it; only to find out whether it was rotated.
    """

    video: Path
    poses: Path | None = None
    masks: Path | None = None
    cameras: str | None = None
    body: Path | None = None
    frames: slice | None = None
    invert_masks: bool | None = None
    live: bool = False
    person: str | None = None
    idle_s: float = IDLE_TIMEOUT_S
    watch_s: float | None = None
    height_m: float | None = None
    tracker: str | None = None
    refine_masks: bool = True
    rotate: int = 0
    transposed: bool = False

    @property
    def is_live(self) -> bool:
        """Return whether frames come from a camera, or from a folder that still grows."""
        return self.live or camera_address(self.video) is not None

    def input_paths(self) -> list[Path]:
        """Paths that no output may touch: those that were named, and those that may be found."""
        named = [self.poses, self.body]
        if camera_address(self.video) is None:
            named.append(self.video)
        if segmenter_name(self.masks) is None:
            named.append(self.masks)
        if self.cameras not in (None, "static", "solve"):
            named.append(Path(self.cameras))
        given = [path for path in named if path is not None]
        near = {path if path.is_dir() else path.parent for path in (self.video, self.poses) if path}
        return [*given, *find_parts(sorted(near))]


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """A video of one person, with everything that belongs to it.

    Attributes:
        masks: None if the images' alpha channel is the mask, `segment` estimates them, or `live`
            makes them.
        cameras: The cameras, of the frames' size.
        size_px: Longer side of the training images; None for the frames' own.
        notes: Messages for the user about how the parts were read.
        live: Tracks the person while the frames come; `motion` is that of the first frames.
        segment: Estimates the masks, if no file or alpha channel holds them.
        mask_refiner: Refines given masks; None if they stay as they are.
        camera_report: Entry of the report about solved cameras.
        tracking_report: Entry of the report about poses that were tracked in the video.
        refit: The fit of the poses to the masks, if they were made for another body.
        fit: The result of fitting to the masks before training (`preprocess.fitting`).
    """

    paths: CapturePaths
    source: FrameSource
    motion: Motion
    masks: Masks | None
    cameras: CameraTrack
    shaped: ShapedBody
    size_px: int | None
    notes: tuple[str, ...]
    live: LiveTracking | None = None
    segment: Segmenter | None = None
    mask_refiner: GivenMaskRefiner | None = None
    camera_report: dict[str, Any] | None = None
    tracking_report: dict[str, Any] | None = None
    refit: BodyPlacement | None = None
    fit: CaptureFit | None = None

    @property
    def identity(self) -> str:
        """Name of the video in a checkpoint; each recording of a camera is a new one."""
        source = self.source
        if camera_address(source.path) is not None:
            return f"{source.path} {source.started_at:.3f}"
        return str(source.path.resolve())

    @property
    def pose_uncertainty(self) -> float:
        """Degree to which the poses are estimates, in [0, 1]: 1 if they were tracked here.

        Given poses are as uncertain as the fit to the masks had to change them beyond its noise.
        """
        if self.live is not None or self.motion.proportions is not None:
            return 1.0
        return 0.0 if self.fit is None else self.fit.share

    def check(self) -> None:
        """Raise an InputError if the parts do not fit together; no frame is read."""
        self.observation_builder()
        self.pixel_footprint_m()

    def observations(self) -> Iterator[Observation | DroppedFrame]:
        """Frames with pose, mask and camera, in order, lazily; every call starts from the first."""
        return map(self.observation_builder(), self.source.frames())

    def observation_builder(self) -> Callable[[Frame], Observation | DroppedFrame]:
        """Make the function that joins a frame with its pose, mask and camera."""
        if self.live is not None:
            return self.live.observation_builder(
                self.source, self.cameras, self.size_px, segment=self.segment,
                refine=self.mask_refiner,
            )  # fmt: skip
        return observation_builder(
            self.source, self.motion, self.masks, self.cameras, size_px=self.size_px,
            segment=self.segment, refine=self.mask_refiner,
        )  # fmt: skip

    def take_revised_poses(self) -> dict[int, BodyPose]:
        """Poses of a stream's earlier frames that later ones have improved since the last call."""
        return {} if self.live is None else self.live.take_revised_poses()

    def mask_report(self) -> dict[str, str | float | None]:
        """Origin of the masks, and the agreement of estimated ones with the posed body."""
        if self.segment is not None:
            agreement = getattr(self.segment, "agreement", None)
            name = getattr(self.segment, "name", type(self.segment).__name__)
            return {"masks": f"estimated by {name}", "mask_agreement": agreement}
        if self.live is not None and self.live.given_masks is None:
            return {"masks": "tracked", "mask_agreement": None}
        source = "alpha channel" if self.paths.masks is None else self.paths.masks.name
        refined = self.mask_refiner is not None and self.mask_refiner.is_needed
        return {"masks": f"{source}, refined" if refined else source, "mask_agreement": None}

    def final_notes(self) -> Iterator[str]:
        """Messages for the user that need the frames to have come."""
        if self.live is not None:
            yield from self.live.final_notes()
        if self.mask_refiner is not None and self.mask_refiner.note is not None:
            yield self.mask_refiner.note

    def body_fit_report(self) -> dict[str, float | bool] | None:
        """The fit of the poses to the body that is used; None if none was needed."""
        return None if self.refit is None else self.refit.as_json()

    def geometry(self) -> CaptureGeometry:
        """Poses and cameras of the capture as `CaptureGeometry`."""
        return CaptureGeometry.of(self.motion, self.cameras, self.source)

    def camera_of_pose(self, row: int) -> Camera:
        """The camera that sees one of the poses."""
        return self.cameras[int(self.geometry().camera_rows()[row])]

    def in_real_time(self) -> "Capture":
        """Replay the capture: each frame comes at its own time."""
        return replace(self, source=RealtimePlayback(self.source, PacingClock()))

    def pixel_footprint_m(self, *, as_filmed: bool = False) -> float:
        """Size of one pixel on the body: the dial of the field's resolution.

        `as_filmed` means a pixel of the video, not of the reduced images.

        Raises:
            InputError: If the person is behind the camera.
        """
        claim = self.geometry()
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
        shrinking = 1.0 if as_filmed else min(1.0, (self.size_px or longer) / longer)
        return depth / (max(camera.focal_px) * shrinking)
