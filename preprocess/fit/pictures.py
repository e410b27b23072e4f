"""A few small pictures of a video, and how well a posed body's outline meets their edges."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from capture.camera import Camera
from capture.errors import BadInput
from capture.opening import open_source
from capture.source import Source
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import Claim
from preprocess.doctor.evidence import spread
from preprocess.edges import outside, outward, slope_across
from preprocess.observe import check_cameras
from preprocess.pose import BodyPose
from preprocess.silhouette import NEAR_M, SkinPoints, silhouette

PERSON_PX = 130
"""Height of the person in the small pictures, as the poses have it."""
CANDIDATES, FRAMES = 24, 8
"""Pictures that are decoded, if there is time, and how many of them are looked at."""
PATIENCE_S = 8.0
"""So long pictures are decoded; of a long video the beginning is looked at."""
CLOTHES_M, BESIDE_M, FAR_M = 0.03, 0.04, 0.1
"""Clothes end within the first outside a body; beside its outline is between the others."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
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
class Drawn:
    """A posed body in a picture.

    Attributes:
        away_m: How far the middle of each pixel is outside its outline, metres; inside negative.
        px_per_m: What a metre is in the picture, at the body.
    """

    away_m: Float32[np.ndarray, "height width"]
    px_per_m: float


def glance(claim: Claim, skin: SkinPoints, cameras: CameraTrack, source: Source) -> list[Picture]:
    """Pictures of frames that have a pose, spread over the video or over what is soon decoded.

    Args:
        claim: Poses and cameras.
        skin: The body; its height in the pictures says how small these may be.
        cameras: Those of the claim.
        source: The frames; not of a live source.

    Raises:
        BadInput: If cameras and frames do not belong together, or no picture can be used.
    """
    camera_row, chosen = check_cameras(cameras, source), source.selection
    stride = chosen.step * max(1, (source.frame_count or 1) // CANDIDATES)
    began, found = time.perf_counter(), []
    some = slice(chosen.start + stride // 2 // chosen.step * chosen.step, chosen.stop, stride)
    size_px: tuple[int, int] | None = None
    for frame in open_source(source.path, frames=some).frames():
        row = claim.row_of(frame.index)
        if row is not None and "corrupt" not in frame.flags and frame.index not in cameras.missing:
            camera = camera_row(frame.index)
            seen = claim.camera(camera, source.size_px)
            size_px = size_px or small_size(skin, claim.motion[row], seen)
            rgb = cv2.resize(frame.rgb, size_px, interpolation=cv2.INTER_AREA)
            found.append(Picture(index=frame.index, camera_row=camera, rgb=np.asarray(rgb)))
        if time.perf_counter() - began > PATIENCE_S:
            break
    if not found:
        raise BadInput(f"No picture of {source.path} has both a pose and a camera.")
    return [found[place] for place in spread(len(found), FRAMES)]


def small_size(skin: SkinPoints, pose: BodyPose, camera: Camera) -> tuple[int, int]:
    """Width and height of pictures in which the body is about `PERSON_PX` high; never enlarged.

    Args:
        skin: The body.
        pose: One of its poses.
        camera: Of the picture's own size.
    """
    width, height = camera.size_px
    points = skin.posed(pose).astype(np.float64)
    depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    tall = float(np.ptp(camera.project(points)[:, 1])) if depth.min() > NEAR_M else float(height)
    tall = float(np.clip(tall, 1.0, 2.0 * height)) if np.isfinite(tall) else float(height)
    scale = min(1.0, PERSON_PX / tall)
    return max(8, round(width * scale)), max(8, round(height * scale))


def drawn(claim: Claim, skin: SkinPoints, picture: Picture) -> Drawn | None:
    """The body in a picture; None if the claim has no pose for it, or it is not in the picture."""
    row = claim.row_of(picture.index)
    if row is None:
        return None
    camera = claim.camera(picture.camera_row, picture.size_px)
    points = skin.posed(claim.motion[row])
    depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    shape = silhouette(points, camera)
    if depth.min() < NEAR_M or not shape.any() or shape.all():
        return None
    px_per_m = max(camera.focal_px) / float(np.median(depth))
    away = outside(shape) / np.float32(px_per_m)
    return Drawn(away_m=away, px_per_m=px_per_m)


def edges(claim: Claim, skin: SkinPoints, pictures: Sequence[Picture]) -> float:
    """How many times as strong edges across the body's outline are as such edges beside it.

    About 1 where the body is drawn anywhere, 2 to 5 where a person has its outline. A person's
    outline is not drawn by those who are asked: so, unlike masks that are found around the body
    itself, this says whether poses and pictures belong together at all.
    """
    along = beside = 0.0
    along_px = beside_px = 0
    for picture in pictures:
        body = drawn(claim, skin, picture)
        if body is None:
            continue
        away = body.away_m
        across = slope_across(picture.rgb, outward(away))
        near = (away > 0.0) & (away < CLOTHES_M)
        off = (np.abs(away) > BESIDE_M) & (np.abs(away) < FAR_M)
        along, along_px = along + float(across[near].sum()), along_px + int(near.sum())
        beside, beside_px = beside + float(across[off].sum()), beside_px + int(off.sum())
    if not along_px or not beside_px or beside <= 0.0:
        return 0.0
    return (along / along_px) / (beside / beside_px)
