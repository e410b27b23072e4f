"""A capture: everything that is opened and aligned before its first frame.

What alignment changed is saved with a run, and described for people.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float

from capture.atomic_files import atomic_file
from capture.camera import Camera
from capture.input_error import InputError
from capture.live_sources import camera_address
from capture.source import Frame, FrameSource, PacingClock, RealtimePlayback
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.cameras.camera_file import CameraTrack
from preprocess.capture_inputs import CapturePaths
from preprocess.file_content import read_npz
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.masks.mask_sources import MaskSource
from preprocess.observation import DroppedFrame, Observation, observation_builder


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureFit:
    """The changes that the alignment of a capture makes.

    Attributes:
        coefficients: Proportions, in prior standard deviations.
        corrections: Correction of each row of the motion: root and joint rotations, root position.
        error_before_cm: Root mean square distance between outlines of body and masks, cm; of poses
            that were made of key points: after a fit to these alone.
        error_after_cm: The same before the fit's last iteration, with the whole of the changes.
        share: Share of the changes that is made, in [0, 1], and how far the given poses are
            estimates: none where they are exact, 1 where they were made of key points.
        keypoint_share: Mean weight of joints by the built-in tracker's key points beside the given
            ones, in [0, 1]: 0 where given poses are exact, or were made of key points themselves.
        fits_body: Whether proportions could change; not those of a finished avatar's person.
    """

    coefficients: Float[np.ndarray, "coefficients"]
    focal_factor: float
    corrections: Float[np.ndarray, "poses 75"]
    error_before_cm: float
    error_after_cm: float
    share: float
    keypoint_share: float
    fits_body: bool

    def shape(self, shaped: ShapedBody) -> ShapedBody:
        """The person, with fitted proportions."""
        return ProportionSpace.around(shaped).shape(self.coefficients)

    def correct_motion(self, geometry: CaptureGeometry) -> Motion:
        """The motion of the geometry that was fitted, with a correction of each row."""
        motion, views = geometry.motion, geometry.extrinsics[geometry.camera_rows()]
        poses = ClipPoses.of(motion, range(len(motion)))
        return poses.moved(self.corrections, views[:, :3, :3]).replace_in(motion)

    def describe(self) -> str:
        """Describe the changes, for people."""
        vectors = self.corrections[:, :72].reshape(-1, 24, 3)
        turned = np.degrees(np.linalg.norm(vectors, axis=2)).mean(axis=0)
        given = ""
        if self.keypoint_share:
            given = (
                f" The given poses count by {1.0 - self.keypoint_share:.0%}, those that the "
                "built-in tracker's key points tell by the rest."
            )
        return (
            "Body, poses and focal length were fitted to the masks: their outlines were "
            f"{self.error_before_cm:.1f} cm apart, and {self.error_after_cm:.1f} cm by the fit, of "
            f"which {self.share:.0%} was made (the root turned by {turned[0]:.1f} "
            f"degrees on average, other joints by {turned[1:].mean():.1f}; focal length times "
            f"{self.focal_factor:.2f}).{given}"
        )

    def as_json(self) -> dict[str, float | bool]:
        """Figures for the report."""
        return {
            "taken": self.share > 0.0,
            "share": round(self.share, 3),
            "keypoint_share": round(self.keypoint_share, 3),
            "outline_cm_before": round(self.error_before_cm, 3),
            "outline_cm_after": round(self.error_after_cm, 3),
            "focal_factor": round(self.focal_factor, 4),
        }

    def save(self, path: Path, video: str) -> None:
        """Write the changes, for a run that is resumed; `video` identifies the capture's video."""
        with atomic_file(path) as unfinished:
            np.savez(unfinished, **vars(self), video=video)


def load_capture_fit(path: Path, video: str) -> CaptureFit | None:
    """Read what `CaptureFit.save` wrote; None if there is nothing for this video."""
    if not path.is_file():
        return None
    names = [field.name for field in fields(CaptureFit)]
    try:
        read = read_npz(path, (*names, "video"))
        if str(read["video"]) != video:
            return None
        values: dict[str, Any] = {
            name: read[name] if read[name].ndim else read[name].item() for name in names
        }
        return CaptureFit(**values)
    except (InputError, KeyError):
        return None


def video_identity(source: FrameSource) -> str:
    """Name of a video in a checkpoint; each recording of a camera is a new one."""
    if camera_address(source.path) is not None:
        return f"{source.path} {source.started_at:.3f}"
    return str(source.path.resolve())


class Provenance(NamedTuple):
    """Where a part of a capture comes from, and how sure it is.

    Attributes:
        part: "poses", "body", "cameras", "masks", "tracking" or "fit".
        origin: A file's name, or what made it.
        notes: Messages for the user about how it was read or made; empty ones count as none.
        uncertainty: Degree to which it is an estimate, in [0, 1]; 0 if it counts as exact.
        figures: The part's entry in the report; None without one.
    """

    part: str
    origin: str
    notes: tuple[str | None, ...] = ()
    uncertainty: float = 0.0
    figures: dict[str, Any] | None = None


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
        return tuple(note for each in self.provenance for note in each.notes if note)

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


class ObservationSource:
    """Where a training session gets its observations from: frames, as they are delivered.

    `join` joins the next one with its pose, mask and camera, which are those of the capture.
    """

    def __init__(
        self,
        capture: Capture,
        frames: FrameSource,
        join: Callable[[Frame], Observation | DroppedFrame],
    ) -> None:
        """Read nothing yet."""
        self.capture, self.frames, self.join = capture, frames, join

    def set_catch_up(self, catch_up: bool) -> None:
        """Deliver frames without delay while a resumed run reads back what it has seen."""

    def notes(self) -> Iterator[str]:
        """Messages for the user that need the frames to have come."""
        yield from self.capture.masks.notes()


@final
class RecordedObservations(ObservationSource):
    """The observations of a recording; with `realtime` each frame comes at its own time."""

    def __init__(self, capture: Capture, *, realtime: bool = False) -> None:
        """Read nothing yet; an InputError if the capture's parts do not fit together."""
        self._playback = RealtimePlayback(capture.source, PacingClock())
        frames = self._playback if realtime else capture.source
        super().__init__(capture, frames, capture.observation_builder())

    def set_catch_up(self, catch_up: bool) -> None:
        """Play without delay for a while."""
        self._playback.catch_up = catch_up
