"""SMPL's poses on another body while they come: fitted to the masks seen so far, ever again.

The first picture says how far away the person is, turning says the rest. So what
`preprocess.fit.refit` does is done with the first frame, and whenever there are twice as many.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float32

from capture.frame import Frame
from preprocess.body import ShapedBody
from preprocess.doctor.claim import Claim
from preprocess.doctor.evidence import Evidence, Witness
from preprocess.fit.refit import FRAMES, Refit, moved_pelvis, refitted
from preprocess.kinematics import rotation_matrices
from preprocess.observation import Observation
from preprocess.observe import Dropped
from preprocess.pose import BodyPose, Motion
from preprocess.silhouette import PERSON_PX, SkinPoints


@dataclass(frozen=True, eq=False, kw_only=True)
class _Seen:
    """A frame that is kept: the tracker's own pose, and the mask, small."""

    pose: BodyPose
    alpha: Float32[np.ndarray, "height width"]


@final
class GrowingFit:
    """Fits the poses of one stream, seen by a camera that stands still, to one body.

    Attributes:
        refit: What was found last; None before the first frame.
        frames: On how many frames it rests.
    """

    def __init__(self, shaped: ShapedBody, model: str) -> None:
        """Nothing was seen yet.

        Args:
            shaped: The body that is used.
            model: Whose poses they are.
        """
        self.refit: Refit | None = None
        self.frames = 0
        self._skin, self._model = SkinPoints.of(shaped), model
        self._seen: list[_Seen] = []
        self._count, self._every = 0, 1

    def of(self, observation: Observation) -> Observation:
        """The observation with its pose as it fits the masks, this one among them."""
        if self._count % self._every == 0:
            self._keep(observation)
        self._count += 1
        if self._count >= 2 * self.frames:
            self.frames = self._count
            self.refit = self._found(observation)
        if self.refit is None or not self.refit.worth_it:
            return observation
        return replace(observation, pose=self._moved(observation, self.refit))

    def observing(
        self, observed: Callable[[Frame], Observation | Dropped]
    ) -> Callable[[Frame], Observation | Dropped]:
        """What makes observations of frames, their poses fitted."""

        def fitted(frame: Frame) -> Observation | Dropped:
            seen = observed(frame)
            return seen if isinstance(seen, Dropped) else self.of(seen)

        return fitted

    def _keep(self, observation: Observation) -> None:
        """Remembers a frame; of more than twice what a search takes, every other one goes."""
        alpha = observation.alpha
        if self._seen:
            height, width = self._seen[0].alpha.shape
        else:
            rows = np.flatnonzero((alpha > 0.5).any(axis=1))
            scale = min(1.0, PERSON_PX / (rows[-1] + 1 - rows[0]))
            height, width = (max(8, round(side * scale)) for side in alpha.shape)
        small = cv2.resize(alpha, (width, height), interpolation=cv2.INTER_AREA)
        self._seen.append(_Seen(pose=observation.pose, alpha=small.astype(np.float32)))
        if len(self._seen) >= 2 * FRAMES:
            self._every *= 2
            del self._seen[1::2]

    def _found(self, observation: Observation) -> Refit:
        """What all that is remembered says."""
        poses, camera = [seen.pose for seen in self._seen], observation.camera
        count = len(poses)
        motion = Motion(
            root_rotations=np.stack([pose.root_rotation for pose in poses]),
            root_translations=np.stack([pose.root_translation for pose in poses]),
            joint_rotations=np.stack([pose.joint_rotations for pose in poses]),
            valid=np.ones(count, dtype=bool),
            betas=np.zeros(10),
            model=self._model,
        )
        claim = Claim(
            motion=motion,
            places=np.arange(count, dtype=np.float64),
            intrinsics=camera.intrinsic[None],
            extrinsics=camera.camera_from_world[None],
            size_px=camera.size_px,
            distortion=camera.distortion,
        )
        witnesses = tuple(
            Witness(index=index, camera_row=0, alpha=seen.alpha)
            for index, seen in enumerate(self._seen)
        )
        return refitted(claim, Evidence(witnesses=witnesses, skin=self._skin))

    def _moved(self, observation: Observation, refit: Refit) -> BodyPose:
        pose, rest = observation.pose, self._skin.shaped.joints[0]
        there = moved_pelvis(
            rest + pose.root_translation,
            observation.camera.center_world,
            rotation_matrices(pose.root_rotation),
            refit.nearer,
            refit.shift_m,
        )
        return replace(pose, root_translation=there - rest)
