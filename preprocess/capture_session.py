"""A capture: the inputs of the user, and everything opened and aligned before its first frame."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from capture.camera import Camera
from capture.input_error import InputError
from capture.live_sources import IDLE_TIMEOUT_S, camera_address
from capture.source import Frame, FrameSource
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack
from preprocess.capture_paths import CapturePaths, find_own_poses, find_parts
from preprocess.fitting.capture_fit import CaptureFit
from preprocess.masks.mask_sources import MaskSource
from preprocess.observation import DroppedFrame, Observation, observation_builder
from preprocess.plugins import segmenter_name


class InputKind(Enum):
    """What the input of a command is: a recording with poses or without, or a stream.

    A stream without poses is tracked while it comes: a live source, or a recording that is played
    at its own speed.
    """

    POSED = "recorded, with poses"
    UNTRACKED = "recorded, to be tracked first"
    STREAMED = "tracked while it comes"


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
        realtime: Whether a recording is played at its own speed, as a camera would.
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
    realtime: bool = False

    @property
    def camera(self) -> str | None:
        """Number or address of the camera, if the video is one."""
        return camera_address(self.video)

    @property
    def is_live(self) -> bool:
        """Return whether frames come from a camera, or from a folder that still grows."""
        return self.live or self.camera is not None

    @cached_property
    def kind(self) -> InputKind:
        """What the input is; a video that does not exist counts as posed."""
        if self.is_live:
            return InputKind.STREAMED
        if self.poses or find_own_poses(self.video) or not self.video.exists():
            return InputKind.POSED
        return InputKind.STREAMED if self.realtime else InputKind.UNTRACKED

    def input_paths(self) -> list[Path]:
        """Paths that no output may touch: those that were named, and those that may be found."""
        named = [self.poses, self.body]
        if self.camera is None:
            named.append(self.video)
        if segmenter_name(self.masks) is None:
            named.append(self.masks)
        if self.cameras not in (None, "static", "solve"):
            named.append(Path(self.cameras))
        given = [path for path in named if path is not None]
        near = {path if path.is_dir() else path.parent for path in (self.video, self.poses) if path}
        return [*given, *find_parts(sorted(near))]


def video_identity(source: FrameSource) -> str:
    """Name of a video in a checkpoint; each recording of a camera is a new one."""
    if camera_address(source.path) is not None:
        return f"{source.path} {source.started_at:.3f}"
    return str(source.path.resolve())


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Where a part of a capture comes from, and how sure it is.

    Attributes:
        part: "poses", "body", "cameras", "masks", "tracking" or "fit".
        origin: A file's name, or what made it.
        uncertainty: Degree to which it is an estimate, in [0, 1]; 0 if it counts as exact.
        notes: Messages for the user about how it was read or made.
        figures: The part's entry in the report; empty without one.
    """

    part: str
    origin: str
    uncertainty: float = 0.0
    notes: tuple[str, ...] = ()
    figures: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """A video of one person, with everything that belongs to it, in metres and in one world.

    Attributes:
        motion: The poses; of a stream that is tracked while it comes, those of its first frames.
        cameras: The cameras, of the frames' size.
        size_px: Longer side of the training images.
        provenance: Where the parts come from, in the order in which they were made.
        fits: Changes that were fitted to masks and key points, for a run that is resumed.
    """

    paths: CapturePaths
    source: FrameSource
    motion: Motion
    masks: MaskSource
    cameras: CameraTrack
    shaped: ShapedBody
    size_px: int
    provenance: tuple[Provenance, ...]
    fits: tuple[CaptureFit, ...] = ()

    @property
    def identity(self) -> str:
        """Name of the video in a checkpoint; each recording of a camera is a new one."""
        return video_identity(self.source)

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the user about how the parts were read or made."""
        return tuple(note for each in self.provenance for note in each.notes)

    @property
    def pose_uncertainty(self) -> float:
        """Degree to which the poses are estimates, in [0, 1]: 1 if they were tracked here.

        Given poses are as uncertain as the fit to the masks had to change them beyond its noise.
        """
        return max(each.uncertainty for each in self.provenance if each.part in ("poses", "fit"))

    def figures(self, part: str) -> dict[str, Any] | None:
        """The newest figures of a part for the report; None if there are none."""
        found = [each.figures for each in self.provenance if each.part == part and each.figures]
        return found[-1] if found else None

    def with_part(self, made: Provenance, **parts: Any) -> "Capture":
        """The capture with some parts replaced, and where they come from."""
        return replace(self, provenance=(*self.provenance, made), **parts)

    def check(self) -> None:
        """Raise an InputError if the parts do not fit together; no frame is read."""
        self.observation_builder()
        self.pixel_footprint_m()

    def observations(self) -> Iterator[Observation | DroppedFrame]:
        """Frames with pose, mask and camera, in order, lazily; every call starts from the first."""
        return map(self.observation_builder(), self.source.frames())

    def observation_builder(self) -> Callable[[Frame], Observation | DroppedFrame]:
        """Make the function that joins a frame with its pose, mask and camera."""
        return observation_builder(
            self.source, self.motion, self.masks, self.cameras, size_px=self.size_px
        )

    def mask_report(self) -> dict[str, str | float | None]:
        """Origin of the masks, and the agreement of estimated ones with the posed body."""
        origin = self.masks.origin
        return {
            "masks": f"{origin}, refined" if self.masks.is_refined else origin,
            "mask_agreement": self.masks.agreement,
        }

    def geometry(self) -> CaptureGeometry:
        """Poses and cameras of the capture as `CaptureGeometry`."""
        return CaptureGeometry.of(self.motion, self.cameras, self.source)

    def camera_of_pose(self, row: int) -> Camera:
        """The camera that sees one of the poses."""
        return self.cameras[int(self.geometry().camera_rows()[row])]

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
        shrinking = 1.0 if as_filmed else min(1.0, self.size_px / longer)
        return depth / (max(camera.focal_px) * shrinking)
