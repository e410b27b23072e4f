"""A capture's geometry: poses by frame, cameras, and how the video's images relate to the masks.

This is what corrections change and what the alignment fits. What is implausible in it is found
without rendering.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.source import FrameSource
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack
from preprocess.poses.plausibility import lost_pose_warnings, plausibility_warnings

FULL_WINDOW = (0.0, 0.0, 1.0, 1.0)
"""Window of a video that shows exactly the masks' image."""
VIEW_SECTORS = 12
"""Sectors of directions around the body."""
MIN_VIEW_COVERAGE = 0.5
"""Fraction of the sectors below which the video shows too few sides."""


@dataclass(frozen=True, kw_only=True)
class VideoTransform:
    """The change that turns a video's images into those that the masks belong to.

    Attributes:
        quarter_turns: Quarter turns counter-clockwise by which images are rotated first.
        mirrored: Whether left and right are then exchanged.
        window: Left, top, right and bottom of the video's image within the mask, as fractions of
            the mask's width and height. A cropped video shows less than 0 to 1, a padded one more.
        first_frame: Frame number that the masks and poses have for the video's frame 0.
    """

    quarter_turns: int = 0
    mirrored: bool = False
    window: tuple[float, float, float, float] = FULL_WINDOW
    first_frame: int = 0

    @property
    def reorients(self) -> bool:
        """True if images must be rotated or mirrored."""
        return self.mirrored or self.quarter_turns % 4 != 0

    def reorient(self, image: np.ndarray) -> np.ndarray:
        """Rotate and mirror one of the video's images, or a map of that size."""
        turned = np.rot90(image, self.quarter_turns)
        return np.ascontiguousarray(turned[:, ::-1] if self.mirrored else turned)


IDENTITY_TRANSFORM = VideoTransform()
"""A video whose images masks and poses belong to as they are."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureGeometry:
    """A capture's poses and cameras in a form that a correction can change in one place.

    Attributes:
        motion: The poses; only `row_frames` assigns them to frames.
        row_frames: Frame number of each row of the motion; need not be whole.
        intrinsics, extrinsics: K in pixels and camera-from-world, one for all frames or one per
            frame.
        size_px: Width and height that K belongs to.
        distortion: OpenCV's coefficients of all cameras.
        keeps_person_only: Whether only those components of a mask count that the body touches.
        video_transform: Change of images before masks and poses belong to them.
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
        rows, known = self.rows_for_frames(np.array([frame]))
        return int(rows[0]) if known[0] else None

    def rows_for_frames(
        self, frames: Int[np.ndarray, "frames"]
    ) -> tuple[Int[np.ndarray, "frames"], Bool[np.ndarray, "frames"]]:
        """The valid row nearest to each frame, and whether it belongs to that frame."""
        # rows that are more than six frames apart leave frames without a pose
        reach = 0.5 * min(max(1.0, frame_step(self.row_frames)), 6.0) + 1e-6
        away = np.abs(self.row_frames - frames[:, None])
        away = np.where(self.motion.valid & np.isfinite(away), away, np.inf)
        rows = away.argmin(axis=1)
        return rows, np.take_along_axis(away, rows[:, None], axis=1)[:, 0] <= reach

    def in_video_frames(self, frames: int) -> "CaptureGeometry":
        """The same for a video's own frame numbers and the part of the image that it shows."""
        video = self.video_transform
        low, high = np.array(video.window[:2]), np.array(video.window[2:])
        intrinsics, extrinsics = self.intrinsics.copy(), self.extrinsics
        intrinsics[:, :2, 2] -= low * self.size_px
        intrinsics[:, :2] /= (high - low)[:, None]
        if video.first_frame and len(extrinsics) > 1:
            numbers = (video.first_frame + np.arange(frames)).clip(0, len(extrinsics) - 1)
            intrinsics, extrinsics = intrinsics[numbers], extrinsics[numbers]
        return replace(
            self,
            intrinsics=intrinsics,
            extrinsics=extrinsics,
            row_frames=self.row_frames - video.first_frame,
            video_transform=IDENTITY_TRANSFORM,
        )

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


def rescale_motion(geometry: CaptureGeometry, shaped: ShapedBody, resized: ShapedBody) -> Motion:
    """Move a motion so that a resized body looks the same from its cameras.

    The poses were made for `shaped`; distances from the camera grow with the body.
    """
    factor = resized.height_m / shaped.height_m
    eyes = geometry.camera_centers()[geometry.camera_rows()]
    pelves = shaped.joints[0] + geometry.motion.root_translations
    moved = eyes + factor * (pelves - eyes)
    return replace(geometry.motion, root_translations=moved - resized.joints[0])


def relative_change(before: CaptureGeometry, after: CaptureGeometry) -> float:
    """Relative change of lens, distance or window, whichever is largest."""
    shift = np.abs(after.intrinsics[0, :2, 2] - before.intrinsics[0, :2, 2]) / before.size_px
    focal = after.intrinsics[0, 0, 0] / before.intrinsics[0, 0, 0]
    translations, valid = before.motion.root_translations, before.motion.valid
    moved = np.linalg.norm((after.motion.root_translations - translations)[valid])
    distance = moved / max(float(np.linalg.norm(translations[valid])), 1e-9)
    window = np.abs(np.subtract(after.video_transform.window, before.video_transform.window)).max()
    return max(abs(float(np.log(focal))), float(shift.max()), float(distance), float(window))


def sanity_warnings(geometry: CaptureGeometry, frames: list[int]) -> Iterator[str]:
    """Describe implausible poses and cameras of the selected frames: gaps, jumps, ranges, views."""
    motion = geometry.motion
    yield from lost_pose_warnings(motion)
    bare = [frame for frame in frames if geometry.row_for_frame(frame) is None]
    if len(bare) > int((~motion.valid).sum()):
        yield f"{len(bare)} of {len(frames)} frames have no pose{_list_frames(bare)}."
    yield from plausibility_warnings(motion)
    if len(motion.betas) and np.abs(motion.betas).max() > 6.0:
        yield f"A shape coefficient is {np.abs(motion.betas).max():.1f}; people have -3 to 3."
    yield from _jump_warnings(geometry)
    roots = Rotation.from_rotvec(motion.root_rotations[motion.valid])
    eyes = geometry.camera_centers()[geometry.camera_rows()[motion.valid]]
    seen = view_sector_share(roots.inv().apply(eyes - motion.root_translations[motion.valid]))
    if seen < MIN_VIEW_COVERAGE:
        yield (
            f"The video shows the person from only {seen:.0%} of the directions around them; what "
            "it does not show cannot be learnt. Film the person turning around once."
        )


def view_sector_share(to_cameras: Float[np.ndarray, "views 3"]) -> float:
    """Fraction of the `VIEW_SECTORS` around the body that directions in its axes point to."""
    angle = np.arctan2(to_cameras[:, 0], to_cameras[:, 2]) / (2.0 * np.pi)
    sector = np.floor((angle + 0.5) * VIEW_SECTORS)
    return len(np.unique(sector.clip(0, VIEW_SECTORS - 1))) / VIEW_SECTORS


def _jump_warnings(geometry: CaptureGeometry) -> Iterator[str]:
    """Say before which frames the root jumps, and how many poses repeat the one before."""
    motion = geometry.motion
    if motion.valid.sum() < 3:
        return
    rows = np.flatnonzero(motion.valid)
    rows = rows[np.argsort(geometry.row_frames[rows], kind="stable")]
    near = np.diff(geometry.row_frames[rows]) <= 1.5 * frame_step(geometry.row_frames)
    moved = np.linalg.norm(np.diff(motion.root_translations[rows], axis=0), axis=1)
    roots = Rotation.from_rotvec(motion.root_rotations[rows])
    turned = (roots[:-1].inv() * roots[1:]).magnitude()
    jumped = near & (_outliers(moved, least=0.25) | _outliers(turned, least=np.deg2rad(40.0)))
    still = (near & (moved == 0.0) & (turned == 0.0)).sum() / max(1, near.sum())
    after = [int(geometry.row_frames[row]) for row in rows[1:][jumped]]
    if after:
        times = "once" if len(after) == 1 else f"{len(after)} times"
        yield (
            f"The poses jump {times}{_list_frames(after)}. Did the tracker switch to another "
            "person?"
        )
    if still > 0.2:
        yield f"{still:.0%} of the poses are the same as the one before."


def _outliers(steps: Float[np.ndarray, "steps"], least: float) -> Bool[np.ndarray, "steps"]:
    return (steps > least) & (steps > 6.0 * np.median(steps))  # least: 25 cm, 40 degrees


def _list_frames(frames: list[int]) -> str:
    shown = ", ".join(str(frame) for frame in frames[:6])
    return f" ({shown}{', …' if len(frames) > 6 else ''})"
