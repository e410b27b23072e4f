"""Alignment of SMPL's poses to the masks, on a body that is not SMPL's; and scaling to a height.

Without SMPL's file the height that SMPL's betas state is unknown. Images show only the ratio of
size and distance, so the person is moved instead of scaled: one distance factor and one shift of
the pelvis for the whole motion are fitted so that the body covers the masks. Rotations stay.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import MaskSample, SilhouetteObjective, mean_score
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import soft_iou, splat_silhouette
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import ShapedBody


def body_height_m(shaped: ShapedBody) -> float:
    """Height from the soles to the crown at rest, metres: barefoot, without hair."""
    return float(np.ptp(shaped.vertices[:, 1]))


def scale_to_height(shaped: ShapedBody, height_m: float) -> ShapedBody:
    """Scale a person to a height; proportions stay."""
    factor, body = height_m / body_height_m(shaped), shaped.body
    directions = body.pose_directions
    if directions is not None:
        body = replace(body, pose_directions=factor * directions)
    return ShapedBody(body=body, vertices=factor * shaped.vertices, joints=factor * shaped.joints)


def rescale_motion(geometry: CaptureGeometry, shaped: ShapedBody, resized: ShapedBody) -> Motion:
    """Move a motion so that a resized body looks the same from its cameras.

    The poses were made for `shaped`; distances from the camera grow with the body.
    """
    factor = body_height_m(resized) / body_height_m(shaped)
    eyes = geometry.camera_centers()[geometry.camera_rows()]
    pelves = shaped.joints[0] + geometry.motion.root_translations
    moved = eyes + factor * (pelves - eyes)
    return replace(geometry.motion, root_translations=moved - resized.joints[0])


ALIGNMENT_SAMPLES = 8
"""Frames to whose masks a body is aligned."""
ALIGNMENT_EVALUATIONS = 110
"""Evaluations of the search."""
FIRST_LOG_DISTANCE = 0.08
"""First step of the distance's logarithm."""
FIRST_PELVIS_SHIFT_M = 0.03
"""First step of the pelvis's shift, metres."""
SHIFT_PENALTY = 4.0
"""Penalty of a shift in IoU per m²: from one side, a smaller distance and a shift towards the
camera look alike."""
MIN_ALIGNED_IOU = 0.6
"""Mean IoU from which an alignment is reliable."""
MIN_ALIGNMENT_GAIN = 0.01
"""Gain in mean IoU from which an alignment is taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyPlacement:
    """The poses of a body aligned to masks, with the mean IoU before and after.

    `distance_divisor` divided the distances from the camera; `pelvis_shift_m` moved the pelvis in
    the root's own axes.
    """

    motion: Motion
    iou_before: float
    iou_after: float
    distance_divisor: float
    pelvis_shift_m: Float[np.ndarray, "3"]

    @property
    def is_improvement(self) -> bool:
        """True if the poses fit better by enough to be taken."""
        return self.is_reliable and self.iou_after > self.iou_before + MIN_ALIGNMENT_GAIN

    @property
    def is_reliable(self) -> bool:
        """True if body and masks agree better than by chance."""
        return self.iou_after >= MIN_ALIGNED_IOU

    def describe(self) -> str:
        """Describe the alignment, for people."""
        agreed = f"{self.iou_before:.2f} before, {self.iou_after:.2f} after"
        if not self.is_reliable:
            return (
                f"Their distances could not be fitted to the masks ({agreed}); they stay as they "
                "are."
            )
        if not self.is_improvement:
            return f"Distances fit the masks, as they are (agreement {agreed})."
        return (
            f"Distances were divided by {self.distance_divisor:.3f} and the pelvis moved by "
            f"{100.0 * float(np.linalg.norm(self.pelvis_shift_m)):.1f} cm to fit the masks: "
            f"agreement {agreed}."
        )

    def as_json(self) -> dict[str, float | bool]:
        """The alignment's figures for the report."""
        return {
            "taken": self.is_improvement,
            "agreement_before": round(self.iou_before, 4),
            "agreement_after": round(self.iou_after, 4),
            "distances_divided_by": round(self.distance_divisor, 4),
            "pelvis_moved_cm": round(100.0 * float(np.linalg.norm(self.pelvis_shift_m)), 2),
        }


def place_body_on_masks(geometry: CaptureGeometry, objective: SilhouetteObjective) -> BodyPlacement:
    """Align SMPL's poses, on another body, to the masks of a few frames."""
    from scipy.optimize import minimize  # 0.1 s that a capture in order does not need

    shaped, some = objective.skin.shaped, objective.subset(ALIGNMENT_SAMPLES)
    posed = [_pose_sample(geometry, some, sample) for sample in some.samples]
    posed = [sample for sample in posed if sample is not None]

    def penalized_iou(x: Float[np.ndarray, "4"]) -> float:
        scores = [sample.iou(float(np.exp(x[0])), x[1:]) for sample in posed]
        return float(np.mean(scores)) - SHIFT_PENALTY * float(x[1:] @ x[1:])

    found = np.zeros(4)
    if posed:
        simplex = np.vstack(
            [np.zeros(4), np.diag([FIRST_LOG_DISTANCE, *[FIRST_PELVIS_SHIFT_M] * 3])]
        )
        found = minimize(
            lambda x: -penalized_iou(x), found, method="Nelder-Mead",
            options={"maxfev": ALIGNMENT_EVALUATIONS, "initial_simplex": simplex},
        ).x  # fmt: skip
    divisor = float(np.exp(found[0]))
    motion = _move_motion(geometry, shaped, divisor, found[1:])
    return BodyPlacement(
        motion=motion,
        iou_before=mean_score(objective.frame_scores(geometry)),
        iou_after=mean_score(objective.frame_scores(replace(geometry, motion=motion))),
        distance_divisor=divisor,
        pelvis_shift_m=found[1:],
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _PosedSample:
    """One frame's posed skin, scored at other distances and shifts."""

    points: Float32[np.ndarray, "points 3"]
    pelvis: Float[np.ndarray, "3"]
    root_rotation: Float[np.ndarray, "3 3"]
    geometry: CaptureGeometry
    sample: MaskSample
    size_px: tuple[int, int]

    def iou(self, distance_divisor: float, shift: Float[np.ndarray, "3"]) -> float:
        camera = self.geometry.camera_at(self.sample.camera_row, self.size_px)
        there = move_pelvis(
            self.pelvis, camera.center_world, self.root_rotation, distance_divisor, shift
        )
        points = self.points + (there - self.pelvis).astype(np.float32)
        return soft_iou(splat_silhouette(points, camera), self.sample.alpha)


def move_pelvis(
    pelvis: Float[np.ndarray, "*poses 3"],
    camera_center: Float[np.ndarray, "*poses 3"],
    root_rotation: Float[np.ndarray, "*poses 3 3"],
    distance_divisor: float,
    shift_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "*poses 3"]:
    """Divide a pelvis's distance from the camera, then shift it in the root's axes."""
    return camera_center + (pelvis - camera_center) / distance_divisor + root_rotation @ shift_m


def _pose_sample(
    geometry: CaptureGeometry, objective: SilhouetteObjective, sample: MaskSample
) -> _PosedSample | None:
    row = geometry.row_for_frame(sample.index)
    if row is None:
        return None
    pose = geometry.motion[row]
    return _PosedSample(
        points=objective.posed_points(geometry.motion, row),
        pelvis=objective.skin.shaped.joints[0] + pose.root_translation,
        root_rotation=rotation_matrices(pose.root_rotation),
        geometry=geometry,
        sample=sample,
        size_px=objective.size_px,
    )


def _move_motion(
    geometry: CaptureGeometry,
    shaped: ShapedBody,
    distance_divisor: float,
    shift: Float[np.ndarray, "3"],
) -> Motion:
    """The motion with distances divided, each from its own camera, and the pelvis shifted."""
    eyes = geometry.camera_centers()[geometry.camera_rows()]
    pelves = shaped.joints[0] + geometry.motion.root_translations
    roots = rotation_matrices(geometry.motion.root_rotations)
    moved = move_pelvis(pelves, eyes, roots, distance_divisor, shift)
    return replace(geometry.motion, root_translations=moved - shaped.joints[0])
