"""Incremental alignment of streamed SMPL poses to a body that is not SMPL's.

The first frame determines the person's distance, turning the rest. So the alignment is solved with
the first frame and again whenever the number of frames has doubled, by masks
(`preprocess.alignment.mask_alignment`) or, where there are none, by those that are estimated in
reduced images.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Shaped

from capture.camera import Camera
from capture.source import Frame
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.image_alignment import (
    ImageSample,
    estimate_silhouettes,
    thumbnail_size_px,
)
from preprocess.alignment.mask_alignment import (
    ALIGNMENT_SAMPLES,
    BodyPlacement,
    move_pelvis,
    place_body_on_masks,
)
from preprocess.alignment.silhouette_objective import MaskSample, SilhouetteObjective
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.body_surface import SILHOUETTE_PERSON_PX, SkinPoints
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.observation import DroppedFrame, Observation


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
