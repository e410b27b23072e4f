"""The poses of a clip as rotation matrices, and what is known of them before any image.

All frames are computed at once. Poses are near those given, or merely human.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import (
    PARENTS,
    JointPlaces,
    axis_angles_from_matrices,
    cross_matrices,
    rigid_transform,
    rotation_matrices,
)
from preprocess.fitting.normal_equations import ChainEquations

JOINT_SIGMAS_RAD = (
    (0.10, (1, 2)), (0.10, (4, 5)), (0.08, (7, 8)), (0.01, (10, 11)), (0.04, (3, 6, 9)),
    (0.07, (12, 15)), (0.05, (13, 14)), (0.12, (16, 17)), (0.12, (18, 19)), (0.08, (20, 21)),
    (0.01, (22, 23)),
)  # fmt: skip
"""Prior standard deviation of joints' rotations, radians: of hips, knees, ankles, toes, spine, neck
and head, collars, shoulders, elbows, wrists and hands."""
UNUSUAL_TURN_RAD = 0.08
"""Root mean square of given axis-angles about their mean in `LEFT_PRIORS` and `MIDDLE_PRIORS` at
which the prior counts a quarter, radians: what trackers err by, or else how this person moves."""


class PosedJoints(NamedTuple):
    """World rotation and position (metres) of each joint in a clip's frames."""

    turns: Float[np.ndarray, "frames 24 3 3"]
    places: Float[np.ndarray, "frames 24 3"]

    def world_from_rest(self, rest_joints: JointPlaces) -> Float[np.ndarray, "frames 24 4 4"]:
        """Transforms that carry points of the rest pose with their joints."""
        return rigid_transform(
            self.turns, self.places - (self.turns @ rest_joints[..., None])[..., 0]
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ClipPoses:
    """Poses of a clip's frames.

    `rotations` are those of the root and of each joint relative to its parent; `translations` are
    as in `BodyPose`, metres.
    """

    rotations: Float[np.ndarray, "frames 24 3 3"]
    translations: Float[np.ndarray, "frames 3"]

    @classmethod
    def of(cls, motion: Motion, rows: Sequence[int]) -> "ClipPoses":
        """Some rows of a motion."""
        return cls.stack([motion[row] for row in rows])

    @classmethod
    def stack(cls, poses: Sequence[BodyPose]) -> "ClipPoses":
        """Poses of frames one after the other."""
        vectors = [np.vstack([each.root_rotation, each.joint_rotations]) for each in poses]
        return cls(
            rotations=rotation_matrices(np.stack(vectors)),
            translations=np.stack([each.root_translation for each in poses]).astype(np.float64),
        )

    def replace_in(self, motion: Motion) -> Motion:
        """The motion with these poses in its rows."""
        vectors = axis_angles_from_matrices(self.rotations)
        return replace(
            motion,
            root_rotations=vectors[:, 0],
            root_translations=self.translations,
            joint_rotations=vectors[:, 1:],
        )

    def __getitem__(self, index: int) -> BodyPose:
        """The pose of one frame."""
        turned = axis_angles_from_matrices(self.rotations[index])
        return BodyPose(
            root_rotation=turned[0],
            root_translation=self.translations[index],
            joint_rotations=turned[1:],
        )

    def rows(self, rows: Sequence[int] | Int[np.ndarray, "rows"]) -> "ClipPoses":
        """The poses of some frames."""
        some = list(rows)
        return ClipPoses(rotations=self.rotations[some], translations=self.translations[some])

    def moved(
        self,
        steps: Float[np.ndarray, "frames 75"],
        camera_rotations: Float[np.ndarray, "frames 3 3"],
    ) -> "ClipPoses":
        """The poses after a step.

        Steps hold rotations in the joints' axes, radians, and the translation in the camera's,
        metres; `camera_rotations` are camera from world.
        """
        turned = rotation_matrices(steps[:, :72].reshape(-1, 24, 3))
        shifted = (steps[:, None, 72:] @ camera_rotations)[:, 0]
        return ClipPoses(
            rotations=self.rotations @ turned, translations=self.translations + shifted
        )

    def steps_from(
        self, other: "ClipPoses", camera_rotations: Float[np.ndarray, "frames 3 3"]
    ) -> Float[np.ndarray, "frames 75"]:
        """The steps that `moved` takes from other poses to these."""
        turned = rotation_vectors(other.rotations.swapaxes(-1, -2) @ self.rotations)
        shifted = (camera_rotations @ (self.translations - other.translations)[..., None])[..., 0]
        return np.concatenate([turned.reshape(-1, 72), shifted], axis=1)

    def independent_count(
        self, rest_joints: JointPlaces, camera_rotations: Float[np.ndarray, "frames 3 3"]
    ) -> float:
        """Number of frames that would tell as much of the person if their errors were independent.

        It is the frames' number over the mean sum of the errors' correlations with a frame's. These
        fall with the distance of the poses as the camera sees them: about 12 for a turn, 5 for
        squats filmed from one side, however many frames there are.
        """
        places = self.joints(rest_joints, np.array(PARENTS)).places
        seen = ((places - places[:, :1]) @ camera_rotations.swapaxes(-1, -2)).reshape(-1, 72)
        squares = pdist(seen, "sqeuclidean") / 24.0
        # two frames of one pose share half of their errors' variance, of poses 0.1 m apart less
        shared = float(np.exp(-0.5 * squares / 0.1**2).sum())
        return len(seen) ** 2 / (len(seen) + shared)

    def joints(self, rest_joints: JointPlaces, parents: Int[np.ndarray, "24"]) -> PosedJoints:
        """World rotations and positions of the joints, for a person's rest joints."""
        turns, places = np.empty_like(self.rotations), np.empty((len(self.rotations), 24, 3))
        for joint, parent in enumerate(parents):
            if parent < 0:
                turns[:, joint] = self.rotations[:, joint]
                places[:, joint] = rest_joints[joint] + self.translations
            else:
                turns[:, joint] = turns[:, parent] @ self.rotations[:, joint]
                bone = rest_joints[joint] - rest_joints[parent]
                places[:, joint] = places[:, parent] + turns[:, parent] @ bone
        return PosedJoints(turns, places)


def rotation_vectors(matrices: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Axis-angles of exact rotation matrices, radians."""
    flat = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(matrices.shape[:-1])


def _pose_sigma() -> Float[np.ndarray, "75"]:
    sigma = np.zeros((25, 3))
    sigma[0] = 0.12  # radians
    for value, joints in JOINT_SIGMAS_RAD:
        sigma[list(joints)] = value
    sigma[24] = 0.05, 0.05, 0.25  # metres: across the view, and distance
    return sigma.ravel()


POSE_SIGMA = _pose_sigma()
"""Prior standard deviation of a frame's correction: root and joint rotations, root position. These
are the units of a frame's parameters in the equations."""
LEFT_PRIORS = {
    1: ((0.0, 0.0, 0.0), (0.70, 0.35, 0.30)), 4: ((0.25, 0.0, 0.0), (0.70, 0.12, 0.08)),
    7: ((0.0, 0.0, 0.0), (0.20, 0.13, 0.10)), 10: ((0.0, 0.0, 0.0), (0.10, 0.03, 0.03)),
    13: ((0.0, 0.0, 0.0), (0.15, 0.15, 0.15)), 16: ((0.0, -0.2, -0.8), (0.50, 0.60, 0.70)),
    18: ((0.0, -0.35, 0.0), (0.40, 0.70, 0.08)), 20: ((0.0, 0.0, 0.0), (0.25, 0.20, 0.25)),
    22: ((0.0, 0.0, 0.0), (0.02, 0.02, 0.02)),
}  # fmt: skip
"""Mean and standard deviation of the left joints' axis-angles, radians: hip, knee, ankle, toes,
collar, shoulder, elbow, wrist, hand."""
MIDDLE_PRIORS = {3: 0.08, 6: 0.07, 9: 0.07, 12: 0.20, 15: 0.20}
"""Standard deviation of the axis-angles of spine, neck and head, radians."""
SIGMA_FREE = 30.0
"""Standard deviation of what is not known at all, radians or metres."""
CHANGES_PER_SECOND = (
    (0.04, (0,)), (0.015, (3, 6, 9, 13, 14)), (0.03, (12, 15)), (0.07, (1, 2, 4, 5)),
    (0.05, (7, 8, 20, 21)), (0.005, (10, 11, 22, 23)), (0.11, (16, 17, 18, 19)),
)  # fmt: skip
"""Standard deviation of how far a joint strays from a steady motion in a second, radians."""
CUT_TURN_RAD = 0.25
"""Rotation of the root from frame to frame that photographs show, but no video; at it neighbors
tell a quarter about each other."""
FAST_CHANGE = 2.0
"""Standard deviations of a change between frames at which it counts a quarter (Geman-McClure):
people move fast at times. At 6 the arms of boxers and dancers lag behind their key points."""


@final
class GivenPosePrior:
    """The poses are near given ones, and human where these nearly are.

    Trackers see where a body part points, and less how it lies to its parent: errors of a part's
    rotation relative to the root say nothing about its neighbors' errors. They are alike in all
    frames, or in frames close in time.
    """

    def __init__(
        self,
        given: ClipPoses,
        camera_rotations: Float[np.ndarray, "frames 3 3"],
        frame_numbers: Float[np.ndarray, "frames"],
    ) -> None:
        """Takes the given poses of the frames, and the frames' numbers."""
        self._given, self._cameras = given, camera_rotations
        # prior standard deviations from a frame to the next, growing with the root of the distance
        links = 1.0 / (0.15**2 * np.maximum(np.diff(frame_numbers), 1.0))
        self._links = links[:, None] * _GIVEN_PRECISION
        self._given_turns, self._sigma = _turns_from_root(given), _sigma_beside_given(given)

    def add_to(
        self, equations: ChainEquations, poses: ClipPoses
    ) -> Float[np.ndarray, "frames 75 75"]:
        """Adds it to the equations of a step from the present poses, in units of `POSE_SIGMA`.

        Returns the poses' steps by the parameters that the equations then have: rotations relative
        to the root, in units of `POSE_SIGMA`.
        """
        _add_human(equations, poses, self._sigma)
        steps = _steps_by_turns(poses) * POSE_SIGMA
        equations.change_parameters(steps / POSE_SIGMA[:, None])
        apart = poses.steps_from(self._given, self._cameras)
        turned = self._given_turns.swapaxes(-1, -2) @ _turns_from_root(poses)
        apart[:, 3:72] = rotation_vectors(turned[:, 1:]).reshape(-1, 69)
        apart /= POSE_SIGMA
        # trackers err alike in all frames: what these share counts a tenth
        apart -= 0.9 * apart.mean(axis=0)
        equations.add_chain(apart, _GIVEN_PRECISION, self._links)
        return steps


@final
class HumanPosePrior:
    """Joints turn as people's do: about few axes, and steadily most of the time."""

    def __init__(
        self,
        camera_rotations: Float[np.ndarray, "frames 3 3"],
        times_s: Float[np.ndarray, "frames"],
        *,
        settled: bool = False,
    ) -> None:
        """Takes camera-from-world rotations and times of the frames.

        `settled` tells that the poses were fitted before: no frame is far off its neighbors.
        """
        self._cameras = camera_rotations
        change = np.zeros((25, 3))
        for value, joints in CHANGES_PER_SECOND:
            change[list(joints)] = value
        change[24] = 0.013  # metres
        gaps = np.maximum(np.diff(times_s), 1e-3)
        self._change = change.ravel() * np.sqrt(gaps)[:, None]
        self._steady_frames = 0.17 / float(np.median(gaps)) if len(gaps) else 1.0  # 0.17 s
        # graduated non-convexity: a frame that a tracker got wrong is drawn to its neighbors first
        self._fast_change = FAST_CHANGE if settled else 25.0

    def add_to(
        self, equations: ChainEquations, poses: ClipPoses
    ) -> Float[np.ndarray, "frames 75 75"]:
        """Adds it to the equations of a step; returns the poses' steps by their parameters."""
        _add_human(equations, poses, _SIGMA)
        each, count = np.arange(72, 75), len(poses.rotations)
        equations.blocks[:, each, each] += (POSE_SIGMA[72:] / SIGMA_FREE) ** 2
        before, after = poses.rows(range(count - 1)), poses.rows(range(1, count))
        apart = after.steps_from(before, self._cameras[:-1])
        turned = np.linalg.norm(apart[:, :3], axis=1)
        apart -= gaussian_filter1d(apart, self._steady_frames, axis=0, mode="nearest")
        size = ((apart / self._change) ** 2).reshape(-1, 25, 3).mean(axis=2)
        # Geman-McClure's weight 1 / (1 + e²/k²)², for fast motions and for cuts
        usual = np.repeat(1.0 / (1.0 + size / self._fast_change**2) ** 2, 3, axis=1)
        usual *= 1.0 / (1.0 + (turned / CUT_TURN_RAD) ** 2)[:, None] ** 2
        equations.add_links(apart / POSE_SIGMA, usual * (POSE_SIGMA / self._change) ** 2)
        self._fast_change = max(FAST_CHANGE, 0.5 * self._fast_change)
        return np.broadcast_to(np.diag(POSE_SIGMA), equations.blocks.shape)


def _add_human(equations: ChainEquations, poses: ClipPoses, sigma: JointPlaces) -> None:
    """Adds priors of the joints' axis-angles around their means."""
    # The residual v - mean has the Jacobian J = J_r⁻¹(v): JᵀΣ⁻¹J step = -JᵀΣ⁻¹(v - mean).
    vectors = rotation_vectors(poses.rotations)
    by_step = _inverse_right_jacobian(vectors)
    heavy = by_step / sigma[..., None] ** 2
    blocks = by_step.swapaxes(-1, -2) @ heavy
    right = -(heavy.swapaxes(-1, -2) @ (vectors - _MEAN)[..., None])[..., 0]
    units = POSE_SIGMA[:72].reshape(24, 3)
    blocks *= units[:, :, None] * units[:, None]
    for joint in range(24):
        part = slice(3 * joint, 3 * joint + 3)
        equations.blocks[:, part, part] += blocks[:, joint]
    equations.right[:, :72] += (right * units).reshape(-1, 72)


def _human_priors() -> tuple[JointPlaces, JointPlaces]:
    mean, sigma = np.zeros((24, 3)), np.full((24, 3), SIGMA_FREE)
    for left, (middle, spread) in LEFT_PRIORS.items():
        mean[left], mean[left + 1] = middle, np.array(middle) * (1.0, -1.0, -1.0)
        sigma[left] = sigma[left + 1] = spread
    for joint, spread in MIDDLE_PRIORS.items():
        sigma[joint] = spread
    return mean, sigma


def _sigma_beside_given(given: ClipPoses) -> JointPlaces:
    """Standard deviations of the joints beside given poses, by how far these are from the means.

    A joint that given poses turn far, on one side or the other, is not one that hardly turns.
    """
    away = ((rotation_vectors(given.rotations) - _MEAN) ** 2).mean(axis=0)
    for left in LEFT_PRIORS:
        away[left : left + 2] = away[left : left + 2].mean(axis=0)
    return _SIGMA * (1.0 + away / UNUSUAL_TURN_RAD**2)  # Geman-McClure


def _turns_from_root(poses: ClipPoses) -> Float[np.ndarray, "frames 24 3 3"]:
    """Rotation of each joint relative to the root."""
    turns = poses.rotations.copy()
    for joint, parent in enumerate(PARENTS):
        if parent > 0:
            turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return turns


def _steps_by_turns(poses: ClipPoses) -> Float[np.ndarray, "frames 75 75"]:
    """Derivative of a step of poses by a step of the rotations relative to the root."""
    # R_j = T_parentᵀ T_j, so that a joint's step is its turn's minus R_jᵀ times its parent's
    steps = np.tile(np.eye(75), (len(poses.rotations), 1, 1))
    for joint, parent in enumerate(PARENTS):
        if parent > 0:
            turned = poses.rotations[:, joint].swapaxes(-1, -2)
            steps[:, 3 * joint : 3 * joint + 3, 3 * parent : 3 * parent + 3] = -turned
    return steps


def _given_precision() -> Float[np.ndarray, "75"]:
    """Precision of the given rotations relative to the root, in units of `POSE_SIGMA`."""
    precision = np.full((25, 3), 1.5**-2.0)  # standard deviation in `JOINT_SIGMAS_RAD`
    precision[[0, 24]] = 1.0
    guessed = [10, 11, 22, 23]  # toes and hands
    precision[guessed] = (POSE_SIGMA.reshape(25, 3)[guessed] / 0.12) ** 2  # trackers guess them
    return precision.ravel()


_MEAN, _SIGMA = _human_priors()
_GIVEN_PRECISION = _given_precision()


def _inverse_right_jacobian(
    vectors: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Derivative of the axis-angle of R(v) R(step) by the step, at 0."""
    # I + ½ [v]ₓ + (1/θ² - (1 + cos θ) / (2 θ sin θ)) [v]ₓ²
    angle = np.linalg.norm(vectors, axis=-1)
    safe = np.clip(angle, 1e-3, 3.0)
    factor = 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe))
    cross = cross_matrices(vectors)
    return np.eye(3) + 0.5 * cross + factor[..., None, None] * (cross @ cross)
