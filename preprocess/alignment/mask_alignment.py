"""Alignment of SMPL's poses to the masks, on a body that is not SMPL's; and scaling to a height.

Without SMPL's file the height that SMPL's betas state is unknown. Images show only the ratio of
size and distance, so the person is moved instead of scaled: one distance factor and one shift of
the pelvis for the whole motion are fitted so that the body covers the masks. Rotations stay.

In a stream, the first frame determines the person's distance, turning the rest. So the placement is
solved with the first frame and again whenever the number of frames has doubled, by masks or, where
there are none, by those that are estimated in reduced images.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Shaped

from capture.camera import Camera
from capture.source import Frame
from preprocess.alignment.capture_evidence import (
    ImageSample,
    estimate_silhouettes,
    thumbnail_size_px,
)
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import MaskSample, SilhouetteObjective, mean_score
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.body_surface import (
    SILHOUETTE_PERSON_PX,
    SkinPoints,
    soft_iou,
    splat_silhouette,
)
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.observation import DroppedFrame, Observation

MIN_HEIGHT_CM = 40.0
"""Least height that a user may state, cm."""
MAX_HEIGHT_CM = 260.0
"""Largest height that a user may state, cm."""


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

    Distances from the camera grow with the body.

    Args:
        geometry: Poses and cameras.
        shaped: The person that the poses were made for.
        resized: The same person in another size.
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
    """The result of aligning a body's poses.

    Attributes:
        motion: Poses for the body that is used.
        iou_before: Mean IoU of body and masks as the poses were.
        iou_after: Mean IoU of body and masks with `motion`.
        distance_divisor: Factor by which distances from the camera were divided.
        pelvis_shift_m: Shift of the pelvis in the root's own axes, metres.
    """

    motion: Motion
    iou_before: float
    iou_after: float
    distance_divisor: float
    pelvis_shift_m: Float[np.ndarray, "3"]

    @property
    def is_improvement(self) -> bool:
        """Whether the poses fit better by enough to be taken."""
        return self.is_reliable and self.iou_after > self.iou_before + MIN_ALIGNMENT_GAIN

    @property
    def is_reliable(self) -> bool:
        """Whether body and masks agree better than by chance."""
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
    """Align SMPL's poses, on another body, to the masks of a few frames.

    Args:
        geometry: Poses of SMPL's family, and cameras.
        objective: Masks, and the body.
    """
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
        """IoU after dividing the distance and shifting the pelvis."""
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


@dataclass(frozen=True, eq=False, kw_only=True)
class _KeptFrame:
    """A kept frame: the tracker's own pose, and the mask or the image, small."""

    pose: BodyPose
    thumbnail: Shaped[np.ndarray, "height width *_"]


@final
class LiveAlignment:
    """Fits the poses of one stream of a static camera to one body.

    Attributes:
        placement: The last solution; None before the first frame.
        frame_count: Number of frames that it rests on.
        uses_masks: Whether it is fitted to masks rather than images.
    """

    def __init__(self, shaped: ShapedBody, model: str, *, masked: bool = True) -> None:
        """Start without frames.

        Args:
            shaped: The body that is used.
            model: Body model of the poses.
            masked: Whether frames come with masks; else images are used.
        """
        self.placement: BodyPlacement | None = None
        self.frame_count = 0
        self._skin, self._model, self.uses_masks = SkinPoints.of(shaped), model, masked
        self._seen: list[_KeptFrame] = []
        self._count, self._every = 0, 1

    def align(self, observation: Observation) -> Observation:
        """The observation with its pose fitted to the masks so far, this one included."""
        pose = self._align_pose(observation.pose, observation.camera, observation.alpha)
        return observation if pose is observation.pose else replace(observation, pose=pose)

    def align_observations(
        self, observe: Callable[[Frame], Observation | DroppedFrame]
    ) -> Callable[[Frame], Observation | DroppedFrame]:
        """Wrap an observer: its observations' poses are fitted to their masks."""

        def fitted(frame: Frame) -> Observation | DroppedFrame:
            seen = observe(frame)
            return seen if isinstance(seen, DroppedFrame) else self.align(seen)

        return fitted

    def align_poses(
        self, pose_of: Callable[[Frame], BodyPose | str], camera: Camera
    ) -> Callable[[Frame], BodyPose | str]:
        """Wrap a source of poses: they are fitted to the images before masks are estimated."""

        def fitted(frame: Frame) -> BodyPose | str:
            pose = pose_of(frame)
            return pose if isinstance(pose, str) else self._align_pose(pose, camera, frame.rgb)

        return fitted

    def _align_pose(
        self, pose: BodyPose, camera: Camera, seen: Shaped[np.ndarray, "height width *_"]
    ) -> BodyPose:
        """The pose of a new frame, fitted to all kept masks or images."""
        if self._count % self._every == 0:
            self._keep(pose, camera, seen)
        self._count += 1
        if self._count >= 2 * self.frame_count:
            self.frame_count = self._count
            self.placement = self._solve(camera)
        if self.placement is None or not self.placement.is_improvement:
            return pose
        return self._place(pose, camera, self.placement)

    def _keep(
        self, pose: BodyPose, camera: Camera, seen: Shaped[np.ndarray, "height width *_"]
    ) -> None:
        """Keep a frame; from twice the number of samples on, drop every other one."""
        if self._seen:
            height, width = self._seen[0].thumbnail.shape[:2]
        elif self.uses_masks:
            rows = np.flatnonzero((seen > 0.5).any(axis=1))
            scale = min(1.0, SILHOUETTE_PERSON_PX / (rows[-1] + 1 - rows[0]))
            height, width = (max(8, round(side * scale)) for side in seen.shape)
        else:
            width, height = thumbnail_size_px(self._skin, pose, camera)
        small = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA)
        self._seen.append(_KeptFrame(pose=pose, thumbnail=small))
        if len(self._seen) >= 2 * ALIGNMENT_SAMPLES:
            self._every *= 2
            del self._seen[1::2]

    def _solve(self, camera: Camera) -> BodyPlacement | None:
        """Solve the placement from all kept frames; None if no person is found in them."""
        poses = [seen.pose for seen in self._seen]
        count = len(poses)
        motion = Motion(
            root_rotations=np.stack([pose.root_rotation for pose in poses]),
            root_translations=np.stack([pose.root_translation for pose in poses]),
            joint_rotations=np.stack([pose.joint_rotations for pose in poses]),
            valid=np.ones(count, dtype=bool),
            betas=np.zeros(10),
            body_model=self._model,
        )
        geometry = CaptureGeometry(
            motion=motion,
            row_frames=np.arange(count, dtype=np.float64),
            intrinsics=camera.intrinsic[None],
            extrinsics=camera.camera_from_world[None],
            size_px=camera.size_px,
            distortion=camera.distortion,
        )
        if self.uses_masks:
            samples = tuple(
                MaskSample(index=index, camera_row=0, alpha=seen.thumbnail.astype(np.float32))
                for index, seen in enumerate(self._seen)
            )
            objective = SilhouetteObjective(samples=samples, skin=self._skin)
        else:
            images = [
                ImageSample(index=index, camera_row=0, rgb=seen.thumbnail)
                for index, seen in enumerate(self._seen)
            ]
            objective = estimate_silhouettes(geometry, self._skin, images)
        return None if objective is None else place_body_on_masks(geometry, objective)

    def _place(self, pose: BodyPose, camera: Camera, placement: BodyPlacement) -> BodyPose:
        rest = self._skin.shaped.joints[0]
        there = move_pelvis(
            rest + pose.root_translation,
            camera.center_world,
            rotation_matrices(pose.root_rotation),
            placement.distance_divisor,
            placement.pelvis_shift_m,
        )
        return replace(pose, root_translation=there - rest)
