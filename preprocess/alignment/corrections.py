"""A mistake in a capture as the change that undoes it: those with a size, and their fit to masks.

Fitted to masks are one factor (focal length, size), a principal point, or a camera's whole pose.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import (
    MaskSample,
    SilhouetteObjective,
    mean_score,
    mean_with_missing,
)
from preprocess.body.kinematics import rigid_transform

CAUSES = (
    "mask_polarity", "second_person", "world_frame", "opengl_axes", "root_rotation", "frame_offset",
    "frame_rate", "left_right", "root_origin", "focal", "body_scale", "aspect", "video_rotation",
    "video_mirrored", "video_offset", "video_crop",
)  # fmt: skip
"""Names of the mistakes in commands and files; of equal candidates the first cause is named."""

GeometryChange = Callable[[CaptureGeometry], CaptureGeometry]
CAMERA_SAMPLES = 6
"""Frames to which a camera is fitted."""
MAX_CENTER_OFFSET = 0.45
"""Largest shift of the principal point, as a fraction of the image's sides."""
YAW_STARTS = 24
"""Directions around the person from which the search for a camera starts."""
LEVEL_CAMERAS = {
    "y": np.diag([1.0, -1.0, -1.0]),
    "z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
"""Rotations of level OpenCV cameras, by the axis that is up in the world."""
REFINED_STARTS = 2
"""Best starts that are refined."""
CAMERA_EVALUATIONS = 200
"""Evaluations of one refinement."""
FIRST_TURN_RAD = 0.15
"""First step of the rotation, radians."""
FIRST_SHIFT_M = 0.15
"""First step of the translation, metres."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Correction:
    """One mistake, and the change that undoes it.

    Attributes:
        cause: The mistake, one of `CAUSES`.
        description: What was wrong, for people: ends the sentence "It looks as if …".
        apply: From the geometry as stated to the geometry as it should have been.
        factor: The number that was fitted; None of a discrete mistake.
        frame_shift: Number of frames of an offset; None of any other mistake.
    """

    cause: str
    description: str
    apply: GeometryChange
    factor: float | None = None
    frame_shift: int | None = None


def undo_pose_delay(frames: int) -> Correction:
    """Poses that come too late (positive) or too early by this many frames."""
    late, other = ("late", "early") if frames > 0 else ("early", "late")
    return Correction(
        cause="frame_offset",
        description=f"the poses come {_frame_count(frames)} too {late} (or the masks too {other})",
        apply=lambda c: replace(c, row_frames=c.row_frames - frames),
        frame_shift=frames,
    )


def undo_video_rotation(quarter_turns: int, *, mirrored: bool = False) -> Correction:
    """A video rotated counter-clockwise and perhaps mirrored, unlike its masks and poses.

    Args:
        quarter_turns: Number of quarter turns counter-clockwise.
        mirrored: Whether left and right were exchanged as well.
    """

    def apply(geometry: CaptureGeometry) -> CaptureGeometry:
        video = geometry.video_transform
        turns = (video.quarter_turns - quarter_turns) % 4
        return _with_video(geometry, quarter_turns=turns, mirrored=video.mirrored != mirrored)

    degrees = 90 * (quarter_turns % 4)
    if mirrored:
        what = "mirrored" + (f" and rotated by {degrees}°" if degrees else "")
    else:
        direction = {90: " counter-clockwise", 270: " clockwise"}.get(degrees, "")
        what = f"rotated by {min(degrees, 360 - degrees)}°{direction}"
    return Correction(
        cause="video_mirrored" if mirrored else "video_rotation",
        description=f"the video alone is {what}; its masks and poses belong to images that are not",
        apply=apply,
    )


def undo_video_offset(frames: int) -> Correction:
    """A video whose frame 0 has the masks and poses of frame number `frames`."""
    when = "later" if frames > 0 else "earlier"
    question = "; was its beginning cut off?" if frames > 0 else ""
    return Correction(
        cause="video_offset",
        description=f"the video starts {_frame_count(frames)} {when} than its masks and poses"
        f"{question}",
        apply=lambda c: _with_video(c, first_frame=c.video_transform.first_frame + frames),
        frame_shift=frames,
    )


def undo_video_reversal(frames: int) -> Correction:
    """A video of this many frames that runs backwards against its masks and poses."""
    return Correction(
        cause="video_offset",
        description="the video runs backwards against its masks and poses",
        apply=lambda c: _with_video(c, first_frame=frames - 1, backwards=True),
    )


def undo_video_crop(window: tuple[float, float, float, float]) -> Correction:
    """A video that shows only a part of the masks' image, or has borders added around it.

    Args:
        window: Left, top, right and bottom of the video's image in the mask's, as fractions.
    """
    left, top, right, bottom = window
    inside = right - left < 1.0 and bottom - top < 1.0
    kind = "was cropped" if inside else "has borders, or was scaled down"
    return Correction(
        cause="video_crop",
        description=f"the video {kind} after its masks and poses were made: it shows {left:.0%} to "
        f"{right:.0%} of their width and {top:.0%} to {bottom:.0%} of their height",
        apply=lambda c: _with_video(c, window=window),
        factor=right - left,
    )


def scale_focal_length(factor: float) -> Correction:
    """Focal lengths that are too short (factor above 1) or too long."""
    wrong = "short" if factor > 1.0 else "long"
    return Correction(
        cause="focal",
        description=f"the focal length is too {wrong}; {factor:.3f} times fits",
        apply=lambda c: _with_intrinsics(c, focal_scale=factor),
        factor=factor,
    )


def stretch_width(factor: float) -> Correction:
    """Images that are stretched in width (factor above 1) or in height, unlike the camera."""
    wrong = "width" if factor > 1.0 else "height"
    return Correction(
        cause="aspect",
        description=f"the images are stretched in {wrong}, {max(factor, 1.0 / factor):.2f} times; "
        "was the video converted to another shape?",
        apply=lambda c: _with_intrinsics(c, focal_scale=np.array([factor, 1.0])),
        factor=factor,
    )


def shift_principal_point(right_px: float, down_px: float) -> Correction:
    """Principal points too far left and up by these pixels (negative: right and down)."""
    sides = {
        f"{abs(right_px):.0f} px too far {'left' if right_px > 0.0 else 'right'}": right_px,
        f"{abs(down_px):.0f} px too far {'up' if down_px > 0.0 else 'down'}": down_px,
    }
    where = " and ".join(side for side, px in sides.items() if abs(px) >= 1.0) or "elsewhere"
    return Correction(
        cause="focal",
        description=f"the principal point is {where}; was the video cropped after its poses or its "
        "camera were made?",
        apply=lambda c: _with_intrinsics(c, shift_px=(right_px, down_px)),
    )


def divide_distances(factor: float, pelvis: Float[np.ndarray, "3"]) -> Correction:
    """A person who is too small (factor above 1) or too large for where the poses put them.

    Images show only the ratio of size and distance, and the size is the body's own: distances are
    divided by the factor. With one camera, or cameras in one place, they shrink towards it; else
    the whole world shrinks towards its origin, cameras included.
    """

    def apply(geometry: CaptureGeometry) -> CaptureGeometry:
        centers = geometry.camera_centers()
        is_static = np.ptp(centers, axis=0).max() < 1e-3
        fixed = centers.mean(axis=0) if is_static else np.zeros(3)
        pelves = pelvis + geometry.motion.root_translations
        moved = fixed + (pelves - fixed) / factor
        extrinsics = geometry.extrinsics.copy()
        rotations = extrinsics[:, :3, :3]
        shrunk = fixed + (centers - fixed) / factor
        extrinsics[:, :3, 3] = -np.einsum("cab,cb->ca", rotations, shrunk)
        motion = replace(geometry.motion, root_translations=moved - pelvis)
        return replace(geometry, motion=motion, extrinsics=extrinsics)

    wrong = "small" if factor > 1.0 else "large"
    words = f"the body is too {wrong} for its distance; {factor:.3f} times its size fits"
    return Correction(cause="body_scale", description=words, apply=apply, factor=factor)


def _frame_count(frames: int) -> str:
    return f"{abs(frames)} frame{'s' if abs(frames) > 1 else ''}"


def _with_video(geometry: CaptureGeometry, **changes: Any) -> CaptureGeometry:
    """The geometry with fields of its video transform replaced."""
    return replace(geometry, video_transform=replace(geometry.video_transform, **changes))


def _with_intrinsics(
    geometry: CaptureGeometry,
    *,
    focal_scale: float | Float[np.ndarray, "2"] = 1.0,
    shift_px: tuple[float, float] = (0.0, 0.0),
) -> CaptureGeometry:
    """The geometry with all focal lengths multiplied and all principal points shifted."""
    intrinsics = geometry.intrinsics.copy()
    intrinsics[:, [0, 1], [0, 1]] *= focal_scale
    intrinsics[:, :2, 2] += np.array(shift_px)
    return replace(geometry, intrinsics=intrinsics)


@dataclass(frozen=True, eq=False, kw_only=True)
class _CameraProblem:
    """Posed bodies in the world and their masks, for one static camera."""

    geometry: CaptureGeometry
    objective: SilhouetteObjective

    @cached_property
    def bodies(self) -> list[tuple[Float32[np.ndarray, "points 3"], MaskSample]]:
        """The skin in each sample that has a pose, and the sample."""
        rows = [self.geometry.row_for_frame(sample.index) for sample in self.objective.samples]
        return [
            (self.objective.posed_points(self.geometry.motion, row), sample)
            for row, sample in zip(rows, self.objective.samples, strict=True)
            if row is not None
        ]

    def mean_iou(self, extrinsic: Float[np.ndarray, "4 4"]) -> float:
        """Mean IoU of bodies and masks seen from this camera."""
        geometry = replace(self.geometry, extrinsics=extrinsic[None])
        return mean_score(self.objective.frame_scores(geometry))

    def extrinsic_for(self, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
        """The camera of a given rotation that puts the bodies where the masks are."""
        middle = np.mean([p.mean(axis=0) for p, _ in self.bodies], axis=0)
        extrinsic = rigid_transform(rotation, -rotation @ middle + (0.0, 0.0, 4.0))
        for _ in range(4):
            camera = replace(self.geometry, extrinsics=extrinsic[None]).camera_at(
                0, self.objective.size_px
            )
            drawn = np.median(
                [_point_bounds(camera.project(p[::8])) for p, _ in self.bodies], axis=0
            )
            wanted = np.median([_mask_bounds(each.alpha) for _, each in self.bodies], axis=0)
            depth = float(np.mean([(p @ rotation[2]).mean() for p, _ in self.bodies]))
            far = (depth + extrinsic[2, 3]) * (drawn[3] - drawn[1]) / (wanted[3] - wanted[1])
            off = 0.5 * (wanted[:2] + wanted[2:] - drawn[:2] - drawn[2:])
            extrinsic[:2, 3] += off * far / np.array(camera.focal_px)
            extrinsic[2, 3] = far - depth
        return extrinsic


def fit_factor(
    make: Callable[[float], Correction],
    geometry: CaptureGeometry,
    objective: SilhouetteObjective,
    *,
    near_one: bool = False,
) -> Correction:
    """Fit the one factor of a correction: a coarse grid, then a bounded scalar search.

    Args:
        make: Makes the correction of a factor (`scale_focal_length`, `divide_distances`).
        geometry: The capture that the correction is applied to.
        objective: Masks of a few frames.
        near_one: Skips the grid: the factor is within 20 % of 1.
    """
    from scipy.optimize import minimize_scalar  # 0.1 s that a capture in order does not need

    logs = np.zeros(1) if near_one else np.linspace(-0.8, 0.8, 9)

    def loss(log: float) -> float:
        return -mean_with_missing(objective.frame_scores(make(float(np.exp(log))).apply(geometry)))

    center = float(logs[int(np.argmin([loss(log) for log in logs]))])
    bounds = (center - 0.2, center + 0.2)
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"maxiter": 10})
    return make(float(np.exp(found.x)))


def fit_principal_point(
    geometry: CaptureGeometry, objective: SilhouetteObjective
) -> Correction | None:
    """Fit the principal point that puts the bodies where the masks are.

    None if no mask has a pose, or the shift is too large to be a crop.
    """
    problem = _CameraProblem(geometry=geometry, objective=objective.subset(CAMERA_SAMPLES))
    if not problem.bodies:
        return None
    small = np.array(objective.size_px) / np.array(geometry.size_px)
    wanted = np.stack([_mask_bounds(sample.alpha) for _, sample in problem.bodies])
    drawn = np.stack(
        [
            _point_bounds(
                geometry.camera_at(sample.camera_row, objective.size_px).project(points[::8])
            )
            for points, sample in problem.bodies
        ]
    )
    away = np.median(wanted - drawn, axis=0)
    right, down = 0.5 * (away[:2] + away[2:]) / small
    near = bool((np.abs([right, down]) < MAX_CENTER_OFFSET * np.array(geometry.size_px)).all())
    return shift_principal_point(float(right), float(down)) if near else None


def fit_extrinsics(geometry: CaptureGeometry, objective: SilhouetteObjective) -> Correction | None:
    """Fit the pose of a static camera; None if there are several cameras, or no mask has a pose.

    Starts from level cameras on all sides, in worlds with y or z up; the best are refined freely.
    """
    problem = _CameraProblem(geometry=geometry, objective=objective.subset(CAMERA_SAMPLES))
    if len(geometry.extrinsics) > 1 or not problem.bodies:
        return None
    yaws = [2.0 * np.pi * k / YAW_STARTS for k in range(YAW_STARTS)]
    starts = [
        problem.extrinsic_for(level @ _yaw_rotation(level, yaw))
        for level in LEVEL_CAMERAS.values()
        for yaw in yaws
    ]
    starts.sort(key=problem.mean_iou, reverse=True)
    extrinsic = max(
        (_refine_extrinsics(problem, start) for start in starts[:REFINED_STARTS]),
        key=problem.mean_iou,
    )
    return Correction(
        cause="world_frame",
        description="the poses are in world coordinates and no file gives the camera's position; "
        "one that fits was found from the masks",
        apply=lambda c: replace(c, extrinsics=extrinsic[None]),
    )


def _yaw_rotation(level: Float[np.ndarray, "3 3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation of the world about its up axis."""
    return Rotation.from_rotvec(-angle * level[1]).as_matrix()


def _refine_extrinsics(
    problem: _CameraProblem, start: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Move the camera and turn it about the bodies' center (Nelder-Mead on the mean IoU)."""
    from scipy.optimize import minimize  # 0.1 s that a capture in order does not need

    middle = np.mean([p.mean(axis=0) for p, _ in problem.bodies], axis=0) @ start[:3, :3].T

    def moved(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        return rigid_transform(turn @ start[:3, :3], start[:3, 3] + middle - turn @ middle + x[3:])

    size = np.diag([FIRST_TURN_RAD] * 3 + [FIRST_SHIFT_M] * 3)
    found = minimize(
        lambda x: -problem.mean_iou(moved(x)), np.zeros(6), method="Nelder-Mead",
        options={"maxfev": CAMERA_EVALUATIONS, "initial_simplex": np.vstack([np.zeros(6), size])},
    )  # fmt: skip
    return moved(found.x)


def _point_bounds(pixels: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "4"]:
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def _mask_bounds(alpha: Float32[np.ndarray, "height width"]) -> Float[np.ndarray, "4"]:
    rows, columns = np.nonzero(alpha > 0.5)
    low, high = (columns.min(), rows.min()), (columns.max() + 1, rows.max() + 1)
    return np.array([*low, *high], dtype=np.float64)
