"""A capture's geometry: poses by frame, cameras, and how the video's images relate to the masks.

This is what corrections change and what the alignment fits.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from capture.camera import Camera
from capture.source import FrameSource
from preprocess.body.body_pose import Motion
from preprocess.cameras.camera_file import CameraTrack

FULL_WINDOW = (0.0, 0.0, 1.0, 1.0)
"""Window of a video that shows exactly the masks' image."""

RgbImage = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True)
class VideoTransform:
    """The change that turns a video's images into those that the masks belong to.

    Attributes:
        quarter_turns: Quarter turns counter-clockwise by which images are rotated first.
        mirrored: Whether left and right are then exchanged.
        window: Left, top, right and bottom of the video's image within the mask, as fractions of
            the mask's width and height. A cropped video shows less than 0 to 1, a padded one more.
        first_frame: Frame number that the masks and poses have for the video's frame 0.
        backwards: Whether their numbers descend where the video's ascend.
    """

    quarter_turns: int = 0
    mirrored: bool = False
    window: tuple[float, float, float, float] = FULL_WINDOW
    first_frame: int = 0
    backwards: bool = False

    @property
    def reorients(self) -> bool:
        """Whether images must be rotated or mirrored."""
        return self.mirrored or self.quarter_turns % 4 != 0

    @property
    def renumbers_frames(self) -> bool:
        """Whether frames belong to masks and poses of other numbers."""
        return self.backwards or self.first_frame != 0

    def mask_frame(self, frame: int) -> int:
        """Frame number in masks and poses of one of the video's frames."""
        return self.first_frame - frame if self.backwards else self.first_frame + frame

    def video_frame(self, number: int) -> int:
        """The video's frame of a frame number in masks and poses."""
        return self.first_frame - number if self.backwards else number - self.first_frame

    def reorient(self, image: np.ndarray) -> np.ndarray:
        """Rotate and mirror one of the video's images, or a map of that size."""
        turned = np.rot90(image, self.quarter_turns)
        return np.ascontiguousarray(turned[:, ::-1] if self.mirrored else turned)

    def warp_to_mask(
        self, rgb: RgbImage
    ) -> tuple[UInt8[np.ndarray, "rows columns 3"], UInt8[np.ndarray, "rows columns"]]:
        """Warp an image to the mask; and the mask's pixels that the video shows (1)."""
        upright = self.reorient(rgb)
        height, width = upright.shape[:2]
        shown = np.ones((height, width), dtype=np.uint8)
        if self.window == FULL_WINDOW:
            return upright, shown
        affine = self.mask_from_video((width, height))[:2].astype(np.float32)
        shrinks = affine[0, 0] < 1.0
        if shrinks:  # else a padded video would be sampled, not averaged
            upright = cv2.GaussianBlur(upright, (0, 0), max(0.01, 0.5 / affine[0, 0] - 0.4))
        moved = cv2.warpAffine(upright, affine, (width, height), borderMode=cv2.BORDER_REPLICATE)
        inside = cv2.warpAffine(shown, affine, (width, height), flags=cv2.INTER_NEAREST)
        return np.asarray(moved), np.asarray(inside)

    def mask_from_video(self, size_px: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
        """Homography from pixel indices of the upright video to the mask's, at one size."""
        left, top, right, bottom = self.window
        scale = np.array([right - left, bottom - top])
        # The center of pixel i is at i + 0.5.
        moved = np.array([left, top]) * np.array(size_px) + 0.5 * (scale - 1.0)
        return np.array([[scale[0], 0.0, moved[0]], [0.0, scale[1], moved[1]], [0.0, 0.0, 1.0]])


IDENTITY_TRANSFORM = VideoTransform()
"""A video whose images masks and poses belong to as they are."""


MAX_FRAME_STEP = 6.0
"""Frames between consecutive poses beyond which the frames between have no pose."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureGeometry:
    """A capture's poses and cameras in a form that a correction can change in one place.

    Attributes:
        motion: The poses; only `row_frames` assigns them to frames.
        row_frames: Frame number of each row of the motion; need not be whole.
        intrinsics: K in pixels, one for all frames or one per frame.
        extrinsics: Camera-from-world, one for all frames or one per frame.
        size_px: Width and height that K belongs to.
        distortion: OpenCV's coefficients of all cameras.
        masks_inverted: Whether masks are to be inverted before use.
        keeps_person_only: Whether only those components of a mask count that the body touches.
        video_transform: How images are to be changed before masks and poses belong to them.
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
        """The geometry as the files state it.

        Rows without a stated frame or time are taken in order: of all frames, or of the selection.
        """
        first = cameras.cameras[0]
        known = motion.valid[:, None]
        numbers = {  # NaN in what is not valid would spread
            "root_rotations": np.where(known, motion.root_rotations, 0.0),
            "root_translations": np.where(known, motion.root_translations, 0.0),
            "joint_rotations": np.where(known[..., None], motion.joint_rotations, 0.0),
        }
        return cls(
            motion=replace(motion, **numbers),
            row_frames=_row_frames(motion, source),
            intrinsics=np.stack([camera.intrinsic for camera in cameras.cameras]),
            extrinsics=np.stack([camera.camera_from_world for camera in cameras.cameras]),
            size_px=first.size_px,
            distortion=first.distortion,
        )

    def row_for_frame(self, frame: int) -> int | None:
        """The valid row nearest to a frame; None if it belongs to another frame."""
        reach = 0.5 * min(max(1.0, frame_step(self.row_frames)), MAX_FRAME_STEP) + 1e-6
        away = np.where(self.motion.valid, np.abs(self.row_frames - frame), np.inf)
        row = int(np.argmin(away))
        return row if away[row] <= reach else None

    def camera_rows(self) -> Int[np.ndarray, "poses"]:
        """Index of the camera of each pose."""
        numbers = np.nan_to_num(self.row_frames).round().astype(np.int64)
        return numbers.clip(0, len(self.extrinsics) - 1)

    def camera_centers(self) -> Float[np.ndarray, "cameras 3"]:
        """Camera centers in the world, metres."""
        rotations, offsets = self.extrinsics[:, :3, :3], self.extrinsics[:, :3, 3]
        return -np.einsum("cba,cb->ca", rotations, offsets)

    def camera_at(self, row: int, size_px: tuple[int, int]) -> Camera:
        """One camera, for images of another size of the same aspect ratio."""
        row = min(row, len(self.extrinsics) - 1)
        camera = Camera.from_intrinsic(
            self.intrinsics[row], self.size_px, self.extrinsics[row], self.distortion
        )
        return camera.resize(size_px)


def frame_step(row_frames: Float[np.ndarray, "poses"]) -> float:
    """Median number of frames from one row to the next."""
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
