"""A few small pictures of a video, and how well a posed body's outline meets their edges."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from capture.camera import Camera
from capture.errors import InputError
from capture.opening import open_source
from capture.source import FrameSource
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import CaptureGeometry
from preprocess.doctor.evidence import spaced_indices
from preprocess.edges import signed_distance_px, outward_normals, gradient_along
from preprocess.observe import associate_cameras
from preprocess.pose import BodyPose
from preprocess.silhouette import NEAR_PLANE_M, SkinPoints, splat_silhouette

IMAGE_PERSON_PX = 130
"""Height of the person in the small pictures, as the poses have it."""
MAX_DECODED_IMAGES, ALIGNMENT_IMAGES = 24, 8
"""Pictures that are decoded, if there is time, and how many of them are looked at."""
DECODE_BUDGET_S = 8.0
"""So long pictures are decoded; of a long video the beginning is looked at."""
MAX_CLOTHING_M, OFF_OUTLINE_MIN_M, OFF_OUTLINE_MAX_M = 0.03, 0.04, 0.1
"""Clothes end within the first outside a body; beside its outline is between the others."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageSample:
    """One frame, small.

    Attributes:
        index: The frame's number.
        camera_row: Which camera is its.
        rgb: The picture.
    """

    index: int
    camera_row: int
    rgb: UInt8[np.ndarray, "height width 3"]

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        height, width = self.rgb.shape[:2]
        return int(width), int(height)


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyOutline:
    """A posed body in a picture.

    Attributes:
        signed_distance_m: How far the middle of each pixel is outside its outline, metres; inside negative.
        px_per_m: What a metre is in the picture, at the body.
    """

    signed_distance_m: Float32[np.ndarray, "height width"]
    px_per_m: float


def sample_video(geometry: CaptureGeometry, skin: SkinPoints, cameras: CameraTrack, source: FrameSource) -> list[ImageSample]:
    """Pictures of frames that have a pose, spread over the video or over what is soon decoded.

    Args:
        claim: Poses and cameras.
        skin: The body; its height in the pictures says how small these may be.
        cameras: Those of the claim.
        source: The frames; not of a live source.

    Raises:
        InputError: If cameras and frames do not belong together, or no picture can be used.
    """
    camera_row, chosen = associate_cameras(cameras, source), source.selection
    stride = chosen.step * max(1, (source.frame_count or 1) // MAX_DECODED_IMAGES)
    began, found = time.perf_counter(), []
    some = slice(chosen.start + stride // 2 // chosen.step * chosen.step, chosen.stop, stride)
    size_px: tuple[int, int] | None = None
    for frame in open_source(source.path, frames=some).frames():
        row = geometry.row_for_frame(frame.index)
        if row is not None and "corrupt" not in frame.flags and frame.index not in cameras.frames_without_camera:
            camera = camera_row(frame.index)
            seen = geometry.camera_at(camera, source.size_px)
            size_px = size_px or thumbnail_size_px(skin, geometry.motion[row], seen)
            rgb = cv2.resize(frame.rgb, size_px, interpolation=cv2.INTER_AREA)
            found.append(ImageSample(index=frame.index, camera_row=camera, rgb=np.asarray(rgb)))
        if time.perf_counter() - began > DECODE_BUDGET_S:
            break
    if not found:
        raise InputError(f"No picture of {source.path} has both a pose and a camera.")
    return [found[place] for place in spaced_indices(len(found), ALIGNMENT_IMAGES)]


def thumbnail_size_px(skin: SkinPoints, pose: BodyPose, camera: Camera) -> tuple[int, int]:
    """Width and height of pictures in which the body is about `PERSON_PX` high; never enlarged.

    Args:
        skin: The body.
        pose: One of its poses.
        camera: Of the picture's own size.
    """
    width, height = camera.size_px
    points = skin.posed(pose).astype(np.float64)
    depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    tall = float(np.ptp(camera.project(points)[:, 1])) if depth.min() > NEAR_PLANE_M else float(height)
    tall = float(np.clip(tall, 1.0, 2.0 * height)) if np.isfinite(tall) else float(height)
    scale = min(1.0, IMAGE_PERSON_PX / tall)
    return max(8, round(width * scale)), max(8, round(height * scale))


def body_outline(geometry: CaptureGeometry, skin: SkinPoints, sample: ImageSample) -> BodyOutline | None:
    """The body in a picture; None if the claim has no pose for it, or it is not in the picture."""
    row = geometry.row_for_frame(sample.index)
    if row is None:
        return None
    camera = geometry.camera_at(sample.camera_row, sample.size_px)
    points = skin.posed(geometry.motion[row])
    depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    shape = splat_silhouette(points, camera)
    if depth.min() < NEAR_PLANE_M or not shape.any() or shape.all():
        return None
    px_per_m = max(camera.focal_px) / float(np.median(depth))
    away = signed_distance_px(shape) / np.float32(px_per_m)
    return BodyOutline(signed_distance_m=away, px_per_m=px_per_m)


def edge_contrast(geometry: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample]) -> float:
    """How many times as strong edges across the body's outline are as such edges beside it.

    About 1 where the body is drawn anywhere, 2 to 5 where a person has its outline. A person's
    outline is not drawn by those who are asked: so, unlike masks that are found around the body
    itself, this says whether poses and pictures belong together at all.
    """
    along = beside = 0.0
    along_px = beside_px = 0
    for picture in samples:
        body = body_outline(geometry, skin, picture)
        if body is None:
            continue
        away = body.signed_distance_m
        across = gradient_along(picture.rgb, outward_normals(away))
        near = (away > 0.0) & (away < MAX_CLOTHING_M)
        off = (np.abs(away) > OFF_OUTLINE_MIN_M) & (np.abs(away) < OFF_OUTLINE_MAX_M)
        along, along_px = along + float(across[near].sum()), along_px + int(near.sum())
        beside, beside_px = beside + float(across[off].sum()), beside_px + int(off.sum())
    if not along_px or not beside_px or beside <= 0.0:
        return 0.0
    return (along / along_px) / (beside / beside_px)
