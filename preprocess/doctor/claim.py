"""What a capture claims: which pose belongs to which frame, and where the camera stood."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Camera
from capture.source import FrameSource
from preprocess.camera_file import CameraTrack
from preprocess.doctor.film import IDENTITY_TRANSFORM, VideoTransform
from preprocess.pose import Motion

MAX_FRAME_STEP = 6.0
"""EvaluationFrames from one pose to the next beyond which those between have none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureGeometry:
    """A capture's poses and cameras in a form that a cure can change in one place.

    Attributes:
        motion: The poses; how they belong to frames is said by `places` alone.
        places: Frame number that each row belongs to; need not be whole.
        intrinsics, extrinsics: K and camera-from-world, one for all frames or one for each.
        size_px: Width and height that K belongs to.
        distortion: OpenCV's coefficients, of all cameras.
        inverted: Whether masks are to be inverted before they are used.
        alone: Whether of each mask only the parts are used that the body touches.
        film: How pictures are to be changed before masks and poses belong to them.
    """

    motion: Motion
    row_frames: Float[np.ndarray, "poses"]
    intrinsics: Float[np.ndarray, "cameras 3 3"]
    extrinsics: Float[np.ndarray, "cameras 4 4"]
    size_px: tuple[int, int]
    distortion: tuple[float, ...] = ()
    masks_inverted: bool = False
    keeps_person_only: bool = False
    video_transform: VideoTransform = IDENTITY_TRANSFORM

    @classmethod
    def of(cls, motion: Motion, cameras: CameraTrack, source: FrameSource) -> "CaptureGeometry":
        """What the files say, before anything is doubted.

        Rows of no stated frame or time are taken in order: of all frames, or of the wanted ones.
        """
        first = cameras.cameras[0]
        return cls(
            motion=motion,
            places=_row_frames(motion, source),
            intrinsics=np.stack([camera.intrinsic for camera in cameras.cameras]),
            extrinsics=np.stack([camera.camera_from_world for camera in cameras.cameras]),
            size_px=first.size_px,
            distortion=first.distortion,
        )

    def row_for_frame(self, frame: int) -> int | None:
        """The valid row that is nearest to a frame, if it is near enough to be its own."""
        reach = 0.5 * min(max(1.0, frame_step(self.row_frames)), MAX_FRAME_STEP) + 1e-6
        away = np.where(self.motion.valid, np.abs(self.row_frames - frame), np.inf)
        row = int(np.argmin(away))
        return row if away[row] <= reach else None

    def camera_rows(self) -> Int[np.ndarray, "poses"]:
        """Which camera sees each pose."""
        numbers = np.nan_to_num(self.row_frames).round().astype(np.int64)
        return numbers.clip(0, len(self.extrinsics) - 1)

    def camera_centers(self) -> Float[np.ndarray, "cameras 3"]:
        """Where the cameras stand in the world."""
        turned, moved = self.extrinsics[:, :3, :3], self.extrinsics[:, :3, 3]
        return -np.einsum("cba,cb->ca", turned, moved)

    def camera_at(self, row: int, size_px: tuple[int, int]) -> Camera:
        """One camera, for pictures of another size of the same shape."""
        row = min(row, len(self.extrinsics) - 1)
        camera = Camera.from_intrinsic(
            self.intrinsics[row], self.size_px, self.extrinsics[row], self.distortion
        )
        return camera.resize(size_px)


def frame_step(row_frames: Float[np.ndarray, "poses"]) -> float:
    """EvaluationFrames from one row to the next, as a rule."""
    steps = np.diff(np.sort(row_frames[np.isfinite(row_frames)]))
    steps = steps[steps > 0.0]
    return float(np.median(steps)) if len(steps) else 1.0


def _row_frames(motion: Motion, source: FrameSource) -> Float[np.ndarray, "poses"]:
    if motion.frames is not None:
        return motion.frames.astype(np.float64)
    if motion.times_s is not None and source.duration_s:
        span = source.selection.span(source.frames_in_file)
        return motion.times_s * span / source.duration_s
    rows = np.arange(len(motion), dtype=np.float64)
    wanted = source.frame_count or len(motion)
    if abs(len(motion) - source.frames_in_file) <= abs(len(motion) - wanted):
        return rows
    return source.selection.start + rows * source.selection.step
