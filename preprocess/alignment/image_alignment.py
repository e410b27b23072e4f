"""Alignment of a body to images without masks, and the edge contrast of its outline.

At first the body may be off by a fifth of its size. GrabCut (Rother et al. 2004) segments the
person by color in a band of that width around the body's outline; the body is aligned to these
masks, the band becomes narrower, and so on until the body stays. Such masks follow the body:
whether there is a person at all is decided by the images' edges, which are independent of it.
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
from preprocess.masks.graph_cut import cut_foreground
from preprocess.observe import associate_cameras

IMAGE_PERSON_PX = 130
"""Height of the person in the reduced images by the poses, px."""
MAX_DECODED_IMAGES = 24
"""Images to decode within the budget."""
ALIGNMENT_IMAGES = 8
"""Images to align to, of those decoded."""
DECODE_BUDGET_S = 8.0
"""Time for decoding, seconds; of a long video only the beginning is decoded."""
MAX_CLOTHING_M = 0.03
"""Distance outside the body within which clothes end, metres."""
OFF_OUTLINE_MIN_M = 0.04
"""Least distance from the outline of pixels beside it, metres."""
OFF_OUTLINE_MAX_M = 0.1
"""Largest distance from the outline of pixels beside it, metres."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageSample:
    """One frame's image, reduced.

    Attributes:
        index: Frame number.
        camera_row: Index of the frame's camera.
        rgb: The image.
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
    """The outline of a posed body in an image.

    Attributes:
        signed_distance_m: Distance of each pixel from the outline, metres; negative inside.
        px_per_m: Pixels per metre at the body.
    """

    signed_distance_m: Float32[np.ndarray, "height width"]
    px_per_m: float


def sample_video(
    geometry: CaptureGeometry, skin: SkinPoints, cameras: CameraTrack, source: FrameSource
) -> list[ImageSample]:
    """Decode images of frames that have a pose, spread over the video within the decoding budget.

    Args:
        geometry: Poses and cameras.
        skin: The body; its height in the images determines their size.
        cameras: The cameras of the geometry.
        source: The frames; not a live source.

    Raises:
        InputError: If cameras and frames do not belong together, or no image can be used.
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
        raise InputError(f"No image of {source.path} has both a pose and a camera.")
    return [found[place] for place in spaced_indices(len(found), ALIGNMENT_IMAGES)]


def thumbnail_size_px(skin: SkinPoints, pose: BodyPose, camera: Camera) -> tuple[int, int]:
    """Width and height of images in which the body is about `IMAGE_PERSON_PX` high; never larger.

    Args:
        skin: The body.
        pose: One of its poses.
        camera: Camera of the original image's size.
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
    """Outline of the body in an image; None without a pose, or if it is outside the image."""
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
    """Strength of edges across the body's outline relative to such edges beside it.

    About 1 for a body drawn anywhere, 2 to 5 for a person's outline. Unlike masks estimated around
    the body itself, this shows whether poses and images belong together at all.
    """
    along = beside = 0.0
    along_px = beside_px = 0
    for sample in samples:
        body = body_outline(geometry, skin, sample)
        if body is None:
            continue
        away = body.signed_distance_m
        across = gradient_along(sample.rgb, outward_normals(away))
        near = (away > 0.0) & (away < MAX_CLOTHING_M)
        off = (np.abs(away) > OFF_OUTLINE_MIN_M) & (np.abs(away) < OFF_OUTLINE_MAX_M)
        along, along_px = along + float(across[near].sum()), along_px + int(near.sum())
        beside, beside_px = beside + float(across[off].sum()), beside_px + int(off.sum())
    if not along_px or not beside_px or beside <= 0.0:
        return 0.0
    return (along / along_px) / (beside / beside_px)


UNCERTAIN_BANDS_M = (0.12, 0.05, 0.035)
"""Half width of the uncertain band around the body's outline in each round, metres."""
MAX_INNER_BAND = 0.6
"""Largest width of the band inside, as a fraction of the body's greatest depth in the image."""
CLOTHING_GUESS_M = 0.01
"""Assumed clothing offset, metres."""
BACKGROUND_BORDER_M = 0.25
"""Width of the background around the band from which GrabCut learns its colors, metres."""
GRABCUT_ITERATIONS = 2
"""GrabCut iterations per round."""
MAX_ROUNDS = 6
"""Rounds of segmentation and alignment."""
CONVERGED_DISTANCE = 0.005
"""Relative change of the distance in a round below which the alignment has converged."""
CONVERGED_SHIFT_M = 0.003
"""Shift of the pelvis in a round below which the alignment has converged, metres."""


def place_body_on_images(
    geometry: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample]
) -> BodyPlacement:
    """Align SMPL's poses, on another body, to a few images.

    Args:
        geometry: Poses and cameras; the body may be off by a fifth of its size.
        skin: The body.
        samples: Images; see `sample_video`.
    """
    nearer, shift_m, objective, now = 1.0, np.zeros(3), None, geometry
    for number in range(MAX_ROUNDS):
        found = _estimate_masks(
            now, skin, samples, UNCERTAIN_BANDS_M[min(number, len(UNCERTAIN_BANDS_M) - 1)]
        )
        if found is None:
            break
        objective = found
        step = place_body_on_masks(now, objective)
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
        return np.zeros(0) if objective is None else objective.frame_scores(moved)

    return BodyPlacement(
        motion=now.motion,
        iou_before=mean_score(scores_of(geometry)),
        iou_after=mean_score(scores_of(now)),
        distance_divisor=nearer,
        pelvis_shift_m=shift_m,
        edge_contrast=(edge_contrast(geometry, skin, samples), edge_contrast(now, skin, samples)),
    )


def _estimate_masks(
    geometry: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample], band_m: float
) -> SilhouetteObjective | None:
    """Estimated masks of all images that show the body; None if none does."""
    masks = []
    for sample in samples:
        body = body_outline(geometry, skin, sample)
        person = None if body is None else grabcut_near_outline(sample.rgb, body, band_m)
        if person is not None:
            alpha = person.astype(np.float32)
            row = sample.camera_row
            masks.append(MaskSample(index=sample.index, camera_row=row, alpha=alpha))
    return SilhouetteObjective(samples=tuple(masks), skin=skin) if masks else None


def grabcut_near_outline(
    rgb: UInt8[np.ndarray, "height width 3"], outline: BodyOutline, band_m: float
) -> Bool[np.ndarray, "height width"] | None:
    """Segment the person in a band around a body's outline; None if that fails.

    Args:
        rgb: The image.
        outline: Approximate outline of the body.
        band_m: Half width of the uncertain band, metres; narrower inside thin bodies.
    """
    away = outline.signed_distance_m - np.float32(CLOTHING_GUESS_M)
    inwards = min(band_m, MAX_INNER_BAND * float(-away.min()))
    labels = np.where(away < 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[away >= band_m], labels[away <= -inwards] = cv2.GC_BGD, cv2.GC_FGD
    margin = int(BACKGROUND_BORDER_M * outline.px_per_m) + 1
    person = cut_foreground(rgb, labels, away < band_m, margin, GRABCUT_ITERATIONS)
    return person if person is not None and person.any() else None
