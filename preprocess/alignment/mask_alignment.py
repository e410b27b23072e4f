"""A person's stated height: body, distances and whatever hangs on them become that large.

SMPL's poses on a body that is not SMPL's: distance and place are solved anew from masks.

Without SMPL's file nobody knows how tall SMPL's betas make the person. In pictures only the ratio
of size and distance shows, so the person is moved instead of scaled: by one distance and one shift
of the pelvis for the whole motion, so that the body covers the masks. Rotations stay.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import MaskSample, SilhouetteObjective, mean_score
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.silhouette import soft_iou, splat_silhouette

MIN_HEIGHT_CM, MAX_HEIGHT_CM = 40.0, 260.0


def body_height_m(shaped: ShapedBody) -> float:
    """From the soles to the crown at rest, metres: barefoot, without hair."""
    return float(np.ptp(shaped.vertices[:, 1]))


def scale_to_height(shaped: ShapedBody, height_m: float) -> ShapedBody:
    """The same person in another size; proportions stay."""
    factor, body = height_m / body_height_m(shaped), shaped.body
    directions = body.pose_directions
    if directions is not None:
        body = replace(body, pose_directions=factor * directions)
    return ShapedBody(body=body, vertices=factor * shaped.vertices, joints=factor * shaped.joints)


def rescale_motion(geometry: CaptureGeometry, shaped: ShapedBody, resized: ShapedBody) -> Motion:
    """The motion of a body that became larger, as the same pictures show it.

    What the camera sees stays if distances from it grow with the body.

    Args:
        claim: Poses and cameras.
        shaped: The person that the poses were made for.
        taller: The same in the other size.
    """
    factor = body_height_m(resized) / body_height_m(shaped)
    eyes = geometry.camera_centers()[geometry.camera_rows()]
    pelves = shaped.joints[0] + geometry.motion.root_translations
    moved = eyes + factor * (pelves - eyes)
    return replace(geometry.motion, root_translations=moved - resized.joints[0])


ALIGNMENT_SAMPLES = 8
ALIGNMENT_EVALUATIONS = 110
FIRST_LOG_DISTANCE, FIRST_PELVIS_SHIFT_M = 0.08, 0.03
"""First steps of the search: of the distance's logarithm, and of the pelvis's shift."""
SHIFT_PENALTY = 4.0
"""What a shift costs, in agreement per square metre: seen from one side alone, a body is nearer or
was moved towards the camera, and nothing else tells."""
MIN_ALIGNED_IOU, MIN_ALIGNMENT_GAIN = 0.6, 0.01
"""A refit is taken if body and masks then agree by so much, and by more than before."""
MIN_EDGE_CONTRAST = 1.6
"""Without masks edges must be so many times as strong across the body's outline as beside it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyPlacement:
    """What the search found.

    Attributes:
        motion: Poses for the body that is used.
        before, after: Mean agreement of body and masks, in [0, 1].
        nearer: By what distances from the camera were divided.
        shift_m: How the pelvis was moved, in the root's own axes.
        edges: Where masks were found around the body itself (`preprocess.alignment.image_alignment`): how many
            times as strong the pictures' edges are across its outline as beside it, before and
            after; None where masks were given.
    """

    motion: Motion
    iou_before: float
    iou_after: float
    distance_divisor: float
    pelvis_shift_m: Float[np.ndarray, "3"]
    edge_contrast: tuple[float, float] | None = None

    @property
    def is_improvement(self) -> bool:
        """Whether the poses fit so much better that they are to be taken."""
        return self.is_reliable and self.iou_after > self.iou_before + MIN_ALIGNMENT_GAIN

    @property
    def is_reliable(self) -> bool:
        """Whether body and pictures agree, in the end, so much as no chance makes them."""
        if self.edge_contrast is not None and self.edge_contrast[1] < MIN_EDGE_CONTRAST:
            return False
        return self.iou_after >= MIN_ALIGNED_IOU

    def describe(self) -> str:
        """What was done, for people."""
        if not self.is_reliable:
            return self._describe_failure()
        agreed = f"agreement {self.iou_before:.2f} before, {self.iou_after:.2f} after"
        if self.edge_contrast is None:
            with_what = "masks"
        else:
            with_what = "pictures, in which masks were estimated around it"
            agreed += (
                f"; edges across its outline are {self.edge_contrast[1]:.1f} times as strong as beside "
                f"it, before {self.edge_contrast[0]:.1f} times"
            )
        if not self.is_improvement:
            return f"Distances fit the {with_what}, as they are ({agreed})."
        return (
            f"Distances were divided by {self.distance_divisor:.3f} and the pelvis moved by "
            f"{100.0 * float(np.linalg.norm(self.pelvis_shift_m)):.1f} cm to fit the {with_what}: "
            f"{agreed}."
        )

    def _describe_failure(self) -> str:
        """What is said of a search that found nothing."""
        if self.edge_contrast is None:
            return (
                f"Their distances could not be fitted to the masks ({self.iou_before:.2f} before, "
                f"{self.iou_after:.2f} after); they stay as they are."
            )
        return (
            "There are no masks, and where the poses put the body no person was found in the "
            f"pictures (edges across its outline are {self.edge_contrast[1]:.1f} times as strong as beside "
            "it, 2 to 5 times is usual); distances stay as they are. Do poses and video belong "
            "together? Give --masks, with which ia-check can tell what is wrong, or your own SMPL "
            "file (--body)."
        )

    def as_json(self) -> dict[str, float | bool]:
        """The same for the report."""
        told: dict[str, float | bool] = {
            "taken": self.is_improvement,
            "agreement_before": round(self.iou_before, 4),
            "agreement_after": round(self.iou_after, 4),
            "distances_divided_by": round(self.distance_divisor, 4),
            "pelvis_moved_cm": round(100.0 * float(np.linalg.norm(self.pelvis_shift_m)), 2),
        }
        if self.edge_contrast is not None:
            told |= {
                "edges_before": round(self.edge_contrast[0], 2), "edges_after": round(self.edge_contrast[1], 2),
            }  # fmt: skip
        return told


def place_body_on_masks(geometry: CaptureGeometry, objective: SilhouetteObjective) -> BodyPlacement:
    """Fits SMPL's poses to another body with the masks of a few frames.

    Args:
        claim: Poses of SMPL's family, and cameras.
        evidence: Masks, and the body.
    """
    from scipy.optimize import minimize  # 0.1 s that a capture in order does not need

    shaped, some = objective.skin.shaped, objective.subset(ALIGNMENT_SAMPLES)
    scenes = [scene for witness in some.samples if (scene := _pose_sample(geometry, some, witness))]

    def agreed(x: Float[np.ndarray, "4"]) -> float:
        scores = [scene.iou(float(np.exp(x[0])), x[1:]) for scene in scenes]
        return float(np.mean(scores)) - SHIFT_PENALTY * float(x[1:] @ x[1:])

    found = np.zeros(4)
    if scenes:
        simplex = np.vstack(
            [np.zeros(4), np.diag([FIRST_LOG_DISTANCE, *[FIRST_PELVIS_SHIFT_M] * 3])]
        )
        found = minimize(
            lambda x: -agreed(x), found, method="Nelder-Mead",
            options={"maxfev": ALIGNMENT_EVALUATIONS, "initial_simplex": simplex},
        ).x  # fmt: skip
    nearer = float(np.exp(found[0]))
    motion = _move_motion(geometry, shaped, nearer, found[1:])
    return BodyPlacement(
        motion=motion,
        iou_before=mean_score(objective.frame_scores(geometry)),
        iou_after=mean_score(objective.frame_scores(replace(geometry, motion=motion))),
        distance_divisor=nearer,
        pelvis_shift_m=found[1:],
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _PosedSample:
    """One frame: the posed skin, and what a distance and a shift make of it."""

    points: Float32[np.ndarray, "points 3"]
    pelvis: Float[np.ndarray, "3"]
    root_rotation: Float[np.ndarray, "3 3"]
    claim: CaptureGeometry
    witness: MaskSample
    size_px: tuple[int, int]

    def iou(self, nearer: float, shift: Float[np.ndarray, "3"]) -> float:
        """Agreement after both; a camera in the world's middle sees no difference."""
        camera = self.claim.camera_at(self.witness.camera_row, self.size_px)
        there = move_pelvis(self.pelvis, camera.center_world, self.root_rotation, nearer, shift)
        points = self.points + (there - self.pelvis).astype(np.float32)
        return soft_iou(splat_silhouette(points, camera), self.witness.alpha)


def move_pelvis(
    pelvis: Float[np.ndarray, "*poses 3"],
    camera_center: Float[np.ndarray, "*poses 3"],
    root_rotation: Float[np.ndarray, "*poses 3 3"],
    distance_divisor: float,
    shift_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "*poses 3"]:
    """Where a pelvis is after a refit: nearer to the camera's eye, then shifted in its own axes."""
    return camera_center + (pelvis - camera_center) / distance_divisor + root_rotation @ shift_m


def _pose_sample(
    claim: CaptureGeometry, evidence: SilhouetteObjective, witness: MaskSample
) -> _PosedSample | None:
    row = claim.row_for_frame(witness.index)
    if row is None:
        return None
    pose = claim.motion[row]
    return _PosedSample(
        points=evidence.posed_points(claim.motion, row),
        pelvis=evidence.skin.shaped.joints[0] + pose.root_translation,
        root_rotation=rotation_matrices(pose.root_rotation),
        claim=claim,
        witness=witness,
        size_px=evidence.size_px,
    )


def _move_motion(
    claim: CaptureGeometry,
    shaped: ShapedBody,
    distance_divisor: float,
    shift: Float[np.ndarray, "3"],
) -> Motion:
    """The whole motion with distances divided, each from its own camera, and the pelvis shifted."""
    eyes = claim.camera_centers()[claim.camera_rows()]
    pelves = shaped.joints[0] + claim.motion.root_translations
    roots = rotation_matrices(claim.motion.root_rotations)
    moved = move_pelvis(pelves, eyes, roots, distance_divisor, shift)
    return replace(claim.motion, root_translations=moved - shaped.joints[0])
