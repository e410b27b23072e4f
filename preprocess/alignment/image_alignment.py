"""A few small pictures of a video, and how well a posed body's outline meets their edges.

A body fitted to pictures without masks: masks are found around it, it is fitted to them, again.

At first it may stand off by a fifth of its size. So much around its outline is in doubt: GrabCutSegmenter
(Rother et al. 2004) tells by colours who is person there. The body is fitted to these masks, less
is in doubt around the fitted one, and so on until it stands. Masks of this kind follow the body;
whether it found a person is asked of the pictures' edges.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import FrameSource
from capture.source_opening import open_source
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.edge_objective import gradient_along, outward_normals
from preprocess.alignment.mask_alignment import BodyPlacement, place_body_on_masks
from preprocess.alignment.silhouette_objective import (
    MaskSample,
    SilhouetteObjective,
    mean_score,
    spaced_indices,
)
from preprocess.body.body_pose import BodyPose
from preprocess.body.silhouette import (
    NEAR_PLANE_M,
    SkinPoints,
    signed_distance_px,
    splat_silhouette,
)
from preprocess.cameras.camera_file import CameraTrack
from preprocess.observe import associate_cameras

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


def sample_video(
    geometry: CaptureGeometry, skin: SkinPoints, cameras: CameraTrack, source: FrameSource
) -> list[ImageSample]:
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
        if (
            row is not None
            and "corrupt" not in frame.flags
            and frame.index not in cameras.frames_without_camera
        ):
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
    tall = (
        float(np.ptp(camera.project(points)[:, 1])) if depth.min() > NEAR_PLANE_M else float(height)
    )
    tall = float(np.clip(tall, 1.0, 2.0 * height)) if np.isfinite(tall) else float(height)
    scale = min(1.0, IMAGE_PERSON_PX / tall)
    return max(8, round(width * scale)), max(8, round(height * scale))


def body_outline(
    geometry: CaptureGeometry, skin: SkinPoints, sample: ImageSample
) -> BodyOutline | None:
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


def edge_contrast(
    geometry: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample]
) -> float:
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


UNCERTAIN_BANDS_M = (0.12, 0.05, 0.035)
"""How far inside and outside of the body's outline pixels are in doubt, round after round."""
MAX_INNER_BAND = 0.6
"""Pixels this deep in the body (as a share of the deepest) are person for sure, at the least."""
CLOTHING_GUESS_M = 0.01
"""How far clothes stand off, as a guess."""
BACKGROUND_BORDER_M = 0.25
"""How much of the background is looked at."""
GRABCUT_ITERATIONS = 2
MAX_ROUNDS, CONVERGED_DISTANCE, CONVERGED_SHIFT_M = 6, 0.005, 0.003
"""Rounds at most; the body stands if a round changes its distance and its place by less."""


def place_body_on_images(
    geometry: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample]
) -> BodyPlacement:
    """Fits SMPL's poses to another body with a few pictures.

    Args:
        claim: Poses and cameras; the body may be off by a fifth of its size, or of its place.
        skin: The body.
        pictures: See `sample_video`.
    """
    nearer, shift_m, evidence, now = 1.0, np.zeros(3), None, geometry
    for number in range(MAX_ROUNDS):
        found = _estimate_masks(
            now, skin, samples, UNCERTAIN_BANDS_M[min(number, len(UNCERTAIN_BANDS_M) - 1)]
        )
        if found is None:
            break
        evidence = found
        step = place_body_on_masks(now, evidence)
        now = replace(now, motion=step.motion)
        nearer, shift_m = (
            nearer * step.distance_divisor,
            shift_m / step.distance_divisor + step.pelvis_shift_m,
        )
        stands = (
            abs(step.distance_divisor - 1.0) < CONVERGED_DISTANCE
            and np.linalg.norm(step.pelvis_shift_m) < CONVERGED_SHIFT_M
        )
        if number + 1 >= len(UNCERTAIN_BANDS_M) and stands:
            break

    def scores_of(moved: CaptureGeometry) -> Float[np.ndarray, "samples"]:
        return np.zeros(0) if evidence is None else evidence.frame_scores(moved)

    return BodyPlacement(
        motion=now.motion,
        iou_before=mean_score(scores_of(geometry)),
        iou_after=mean_score(scores_of(now)),
        distance_divisor=nearer,
        pelvis_shift_m=shift_m,
        edge_contrast=(edge_contrast(geometry, skin, samples), edge_contrast(now, skin, samples)),
    )


def _estimate_masks(
    claim: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample], band_m: float
) -> SilhouetteObjective | None:
    """The masks of all pictures in which the body is; None if it is in none."""
    witnesses = []
    for picture in samples:
        body = body_outline(claim, skin, picture)
        person = None if body is None else grabcut_near_outline(picture.rgb, body, band_m)
        if person is not None:
            alpha = person.astype(np.float32)
            row = picture.camera_row
            witnesses.append(MaskSample(index=picture.index, camera_row=row, alpha=alpha))
    return SilhouetteObjective(samples=tuple(witnesses), skin=skin) if witnesses else None


def grabcut_near_outline(
    rgb: UInt8[np.ndarray, "height width 3"], outline: BodyOutline, band_m: float
) -> Bool[np.ndarray, "height width"] | None:
    """Who is person in a picture, among the pixels near a body's outline; None if that fails.

    Args:
        rgb: The picture.
        body: Where the body is, roughly.
        band_m: How far inside and outside pixels are in doubt, if limbs are not thinner.
    """
    away = outline.signed_distance_m - np.float32(CLOTHING_GUESS_M)
    inwards = min(band_m, MAX_INNER_BAND * float(-away.min()))
    labels = np.where(away < 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[away >= band_m], labels[away <= -inwards] = cv2.GC_BGD, cv2.GC_FGD
    rows, columns = np.nonzero(away < band_m)
    if not len(rows):
        return None
    margin = int(BACKGROUND_BORDER_M * outline.px_per_m) + 1
    box = (
        slice(max(0, int(rows.min()) - margin), int(rows.max()) + margin + 1),
        slice(max(0, int(columns.min()) - margin), int(columns.max()) + margin + 1),
    )
    part = np.ascontiguousarray(labels[box])
    if not (part & 1).any() or (part & 1).all():
        return None
    cv2.setRNGSeed(0)
    models, bgr = (np.zeros((1, 65)), np.zeros((1, 65))), np.ascontiguousarray(rgb[box][..., ::-1])
    cv2.grabCut(bgr, part, (0, 0, 1, 1), *models, GRABCUT_ITERATIONS, cv2.GC_INIT_WITH_MASK)
    person = np.zeros(away.shape, dtype=bool)
    person[box] = (part & 1) > 0
    return person if person.any() else None
