"""The key point objective: how near a posed body's key points are to those tracked in a few images.

Key points tell left from right and where each joint is, so factors and cameras are fitted to them
by linear equations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float

from capture.camera import Camera, same_aspect_ratio
from capture.source import AlphaMask, Frame, FrameSource, RgbImage
from capture.source_opening import reopen
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import spaced_indices
from preprocess.body.body_surface import NEAR_PLANE_M
from preprocess.body.kinematics import PARENTS
from preprocess.body.parametric_body import ShapedBody
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.fitting.keypoint_rows import KEYPOINT_JOINTS, KEYPOINT_OFFSETS_M, PIXEL_WEIGHTS
from preprocess.masks.color_models import DarkFilmBrightener
from preprocess.masks.mask_sources import alpha_channel_mask
from preprocess.tracking.blazepose_networks import FoundLandmarks
from preprocess.tracking.first_look import PersonFinder
from preprocess.tracking.keypoints import MIRRORED_POINTS

TRACKED_IMAGES = 16
"""Images in which the person is tracked."""
THUMBNAIL_PX = 300
"""Height of the images that are kept to be shown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedImage:
    """One image, and the person that was tracked in it.

    The thumbnail and the alpha channel (None without one) are reduced. Key points are in pixels of
    the image, and 0 with their confidence if no person was found.
    """

    index: int
    thumbnail: RgbImage
    alpha: AlphaMask | None
    size_px: tuple[int, int]
    image_px: Float[np.ndarray, "33 2"]
    confidence: Float[np.ndarray, "33"]


def track_images(source: FrameSource) -> tuple[TrackedImage, ...]:
    """Find the largest person, upright or not, in images spread over the beginning of a video."""
    chosen = source.selection
    total = min(source.frame_count or 1, 300)  # all of them are decoded
    step = max(1, total // TRACKED_IMAGES)
    first = spaced_indices(total, TRACKED_IMAGES)[0]
    begin, end = (chosen.start + chosen.step * place for place in (first, total))
    wanted = reopen(source, slice(begin, end, chosen.step * step))
    finder, brighten = PersonFinder(), DarkFilmBrightener()
    images: list[TrackedImage] = []
    found: FoundLandmarks | None = None
    for frame in wanted.frames():
        if "corrupt" not in frame.flags:
            found = finder.follow(brighten(frame.rgb), None if found is None else found.square)
            images.append(_reduce_image(frame, found))
    return tuple(images)


def _reduce_image(frame: Frame, found: FoundLandmarks | None) -> TrackedImage:
    """What is kept of a frame and of the person that was found in it."""
    points, confidence = np.zeros((33, 2)), np.zeros(33)
    if found is not None:
        points = found.keypoints.image_px
        confidence = PIXEL_WEIGHTS * found.keypoints.visibility
    width, height = frame.size_px
    size = max(1, round(THUMBNAIL_PX * width / height)), THUMBNAIL_PX
    return TrackedImage(
        index=frame.index,
        thumbnail=np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)),
        alpha=None if frame.alpha is None else alpha_channel_mask(frame, size),
        size_px=frame.size_px,
        image_px=points,
        confidence=confidence,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class KeypointObjective:
    """Scores the geometry of a person by the key points of images in which it was found."""

    images: tuple[TrackedImage, ...]
    shaped: ShapedBody

    @classmethod
    def of(cls, images: Sequence[TrackedImage], shaped: ShapedBody) -> "KeypointObjective | None":
        """The objective of the images in which a person was found; None if there is none."""
        found = tuple(each for each in images if each.confidence.any())
        return cls(images=found, shaped=shaped) if found else None

    @cached_property
    def person_px(self) -> float:
        """Median height of the person in the images, px."""
        return float(np.median([np.ptp(each.image_px, axis=0).max() for each in self.images]))

    @cached_property
    def confidence(self) -> Float[np.ndarray, "images 33"]:
        """Weight of each key point."""
        return np.stack([each.confidence for each in self.images])

    def frame_scores(self, geometry: CaptureGeometry) -> Float[np.ndarray, "images"]:
        """Mean score of each image's key points, in [0, 1]; NaN where the geometry has no pose.

        A key point scores 1 where the body has it, and half at 0.04 person heights from there.
        """
        bodies, found = self.bodies(geometry), self.found_px(geometry)
        if found is None:
            return np.full(len(self.images), np.nan)
        left, top, right, bottom = geometry.video_transform.window
        tall = self.person_px * max(geometry.size_px) / max(self.images[0].size_px)
        tall *= 0.5 * (right - left + bottom - top)
        away = np.linalg.norm(bodies.pixels - found, axis=-1) / (0.04 * tall)
        scores = np.where(bodies.in_camera_m[..., 2] > NEAR_PLANE_M, 1.0 / (1.0 + away**2), 0.0)
        weights = self.confidence
        if geometry.video_transform.mirrored:
            weights = weights[:, MIRRORED_POINTS]
        scores = (weights * scores).sum(axis=1) / weights.sum(axis=1)
        return np.where(bodies.known, scores, np.nan)

    def found_px(self, geometry: CaptureGeometry) -> Float[np.ndarray, "images 33 2"] | None:
        """The key points where masks and cameras expect them, pixels of the cameras' images.

        None if the images have another shape.
        """
        video, (width, height) = geometry.video_transform, self.images[0].size_px
        points = np.stack([each.image_px for each in self.images]) / (width, height)
        for _ in range(video.quarter_turns % 4):
            points = np.stack([points[..., 1], 1.0 - points[..., 0]], axis=-1)
            width, height = height, width
        if not same_aspect_ratio((width, height), geometry.size_px):
            return None
        if video.mirrored:  # what looks like a left hand is a right one
            points = points[:, MIRRORED_POINTS] * (-1.0, 1.0) + (1.0, 0.0)
        low, high = np.array(video.window[:2]), np.array(video.window[2:])
        return (low + points * (high - low)) * geometry.size_px

    def bodies(self, geometry: CaptureGeometry) -> "PosedKeypoints":
        """Key points of the posed body in each image."""
        frames = [geometry.video_transform.first_frame + each.index for each in self.images]
        rows, known = geometry.rows_for_frames(np.array(frames))
        joints = ClipPoses.of(geometry.motion, rows.tolist()).joints(
            self.shaped.joints, np.array(PARENTS)
        )
        offsets = float(np.ptp(self.shaped.vertices[:, 1])) / 1.7 * KEYPOINT_OFFSETS_M
        turned = (joints.turns[:, KEYPOINT_JOINTS] @ offsets[..., None])[..., 0]
        return PosedKeypoints(
            world_m=joints.places[:, KEYPOINT_JOINTS] + turned,
            pelvis_m=joints.places[:, :1],
            cameras=[geometry.camera_at(max(frame, 0), geometry.size_px) for frame in frames],
            known=known,
        )

    def fit(
        self,
        bodies: "PosedKeypoints",
        design: Float[np.ndarray, "images 33 2 numbers"],
        target: Float[np.ndarray, "images 33 2"],
    ) -> Float[np.ndarray, "numbers"]:
        """The numbers for which design times numbers is nearest to the target, robustly.

        Images without a pose, and coordinates whose row of the design is NaN, are left out.
        """
        used = bodies.known[:, None] & (bodies.in_camera_m[..., 2] > NEAR_PLANE_M)
        rows = used[..., None] & np.isfinite(design).all(axis=-1)
        weights = np.broadcast_to(self.confidence[..., None], rows.shape)[rows]
        design, target, robust = design[rows], target[rows], np.float64(1.0)
        numbers = np.zeros(design.shape[-1])
        for _ in range(8 if len(target) else 0):
            scaled = np.sqrt(weights * robust)
            numbers = np.linalg.lstsq(scaled[:, None] * design, scaled * target, rcond=None)[0]
            off = np.abs(design @ numbers - target)
            robust = 1.0 / (1.0 + (off / max(float(np.median(off)), 1e-9)) ** 2)
        return numbers


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedKeypoints:
    """Key points and pelvis of a posed body in some images, in the world.

    `known` tells in which images there is a pose.
    """

    world_m: Float[np.ndarray, "images 33 3"]
    pelvis_m: Float[np.ndarray, "images 1 3"]
    cameras: list[Camera]
    known: Bool[np.ndarray, "images"]

    @cached_property
    def in_camera_m(self) -> Float[np.ndarray, "images 33 3"]:
        """Key points in the axes of their cameras, metres."""
        return self.to_cameras(self.world_m)

    @cached_property
    def pixels(self) -> Float[np.ndarray, "images 33 2"]:
        """Key points in the images, pixels."""
        with np.errstate(divide="ignore", invalid="ignore"):
            pairs = zip(self.cameras, self.world_m, strict=True)
            return np.stack([camera.project(points) for camera, points in pairs])

    @cached_property
    def focal_px(self) -> Float[np.ndarray, "images 1 2"]:
        """Focal lengths."""
        return np.array([[each.focal_px] for each in self.cameras])

    @cached_property
    def center_px(self) -> Float[np.ndarray, "images 1 2"]:
        """Principal points."""
        return np.array([[each.center_px] for each in self.cameras])

    def to_cameras(
        self, world_m: Float[np.ndarray, "images points 3"]
    ) -> Float[np.ndarray, "images points 3"]:
        """Points in the axes of each image's camera, metres."""
        extrinsics = np.stack([each.camera_from_world for each in self.cameras])
        return world_m @ extrinsics[:, :3, :3].swapaxes(1, 2) + extrinsics[:, None, :3, 3]
