"""Fit of our body to the joints of another one: proportions of a person, and poses over time.

Bodies differ in how their joints rest and turn, but all say where hips, knees and wrists are. Our
joints are brought there by Gauss-Newton; what places leave open (twists, the spine's curve) follows
from knuckles, eyes and toes where they are known, from what is human, and from neighboring frames.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from preprocess.body.kinematics import JOINT_NAMES, rotation_matrices
from preprocess.body.parametric_body import load_body_model
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_poses import POSE_SIGMA, ClipPoses, HumanPosePrior
from preprocess.fitting.keypoint_rows import KEYPOINT_JOINTS, KEYPOINT_OFFSETS_M, AttachedPoints
from preprocess.fitting.normal_equations import ChainEquations
from preprocess.tracking.pose_lift import PLACED_JOINTS, PLACED_POINTS, lift_pose

LANDMARKS = {
    "nose": 0, "left_eye": 2, "right_eye": 5, "left_ear": 7, "right_ear": 8, "left_pinky": 17,
    "right_pinky": 18, "left_index": 19, "right_index": 20, "left_thumb": 21, "right_thumb": 22,
    "left_heel": 29, "right_heel": 30, "left_toe": 31, "right_toe": 32,
}  # fmt: skip
"""Further points that tell how parts are turned, by their numbers among BlazePose's key points."""
POINT_NAMES = (*JOINT_NAMES, *LANDMARKS)
"""Points of a `JointTrack`, in their order."""
JOINT_SIGMAS_M = (
    (0.004, (1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21)), (0.006, (10, 11)), (0.02, (15,)),
    (0.03, (0, 12)), (0.05, (3, 6, 9, 13, 14, 22, 23)),
)  # fmt: skip
"""Standard deviation between joints of the same name of two bodies, metres: limbs, toes, head, then
those of which bodies differ in meaning (pelvis, neck, then spine, collars and hands)."""
SIGMA_LANDMARK_M = 0.012
"""The same of landmarks, metres."""
COMPARED_JOINTS = (1, 2, 4, 5, 7, 8, 10, 11, 12, 15, 16, 17, 18, 19, 20, 21)
"""Joints whose distance is stated: all but pelvis, spine, collars and hands, which bodies have in
different places."""
FRAMES_PER_PRIOR = 1.0
"""Frames that count as one for the proportions."""
KEY_FRAMES = 60
"""Frames, evenly spread, to which proportions are fitted."""
CHUNK_FRAMES = 300
"""Frames whose poses are fitted at once."""
ITERATIONS = 12
"""Gauss-Newton iterations of proportions and poses."""
POSE_ITERATIONS = 6
"""Gauss-Newton iterations of poses alone."""
MAX_TURN_STEP_RAD = 0.5
"""Largest change of a rotation's component in one iteration, radians."""
HELD_PRECISION = 1e9
"""Precision that holds proportions that are not fitted."""


class FittedJoints(NamedTuple):
    """Poses and proportions of our body.

    Attributes:
        poses: Of the rows with limbs, in their order.
        rows: These rows of the track.
        coefficients: Proportions around the mean of the embedded body.
        distances_m: Distance of each compared joint in each row from the track's; NaN where that
            is unknown.
    """

    poses: ClipPoses
    rows: Int[np.ndarray, "rows"]
    coefficients: Float[np.ndarray, "coefficients"]
    distances_m: Float[np.ndarray, "rows compared"]


def fit_joints(
    places: Float[np.ndarray, "frames points 3"], times_s: Float[np.ndarray, "frames"]
) -> FittedJoints:
    """Fit the embedded body to places of `POINT_NAMES` over time, metres; NaN where unknown.

    Rows without all shoulders, elbows, wrists, hips, knees and ankles are left out.
    """
    rows = np.flatnonzero(np.isfinite(places[:, PLACED_JOINTS]).all(axis=(1, 2)))
    if not len(rows):
        raise ValueError("no frame has all shoulders, elbows, wrists, hips, knees and ankles")
    fitter = _JointFitter()
    keys = np.unique(np.linspace(0, len(rows) - 1, KEY_FRAMES).round().astype(int))
    fitter.fit(places[rows[keys]], times_s[rows[keys]], proportions=True)
    parts = [
        fitter.fit(places[some], times_s[some], proportions=False)
        for some in np.array_split(rows, -(-len(rows) // CHUNK_FRAMES))
    ]
    poses = ClipPoses(
        rotations=np.concatenate([part.rotations for part in parts]),
        translations=np.concatenate([part.translations for part in parts]),
    )
    joints = poses.joints(fitter.rest_joints, fitter.space.shaped.body.parents).places
    compared = list(COMPARED_JOINTS)
    apart = np.linalg.norm(joints[:, compared] - places[rows][:, compared], axis=-1)
    return FittedJoints(poses, rows, fitter.coefficients, apart)


class _JointFitter:
    """The embedded body, whose proportions are fitted once and then stay."""

    def __init__(self) -> None:
        self.space = ProportionSpace.around(load_body_model().with_shape())
        self.coefficients = np.zeros(self.space.count)
        numbers = list(LANDMARKS.values())
        joints = np.concatenate([np.arange(24), KEYPOINT_JOINTS[numbers]])
        offsets = np.concatenate([np.zeros((24, 3)), KEYPOINT_OFFSETS_M[numbers]])
        self._attached = AttachedPoints(self.space, joints, offsets)
        sigma = np.full(len(POINT_NAMES), SIGMA_LANDMARK_M)
        for value, some in JOINT_SIGMAS_M:
            sigma[list(some)] = value
        self._precision = sigma**-2

    @property
    def rest_joints(self) -> Float[np.ndarray, "24 3"]:
        """Rest joints of the present proportions, metres."""
        return self.space.shaped.joints + self.space.joint_directions @ self.coefficients

    def fit(
        self,
        places: Float[np.ndarray, "frames points 3"],
        times_s: Float[np.ndarray, "frames"],
        *,
        proportions: bool,
    ) -> ClipPoses:
        """Fit the poses of some frames, and perhaps the proportions."""
        poses = self._lift(places)
        known = np.isfinite(places).all(axis=-1)
        weights = np.repeat(known * self._precision, 3, axis=1)
        wanted = np.nan_to_num(places)
        still = np.broadcast_to(np.eye(3), (len(poses.rotations), 3, 3))
        prior = HumanPosePrior(still, times_s, settled=True)
        for _ in range(ITERATIONS if proportions else POSE_ITERATIONS):
            equations = ChainEquations.empty(len(places), 75, self.space.count)
            found, by_pose, by_shape = self._attached.place(
                poses, self.rest_joints, still, np.zeros((len(places), 3))
            )
            count = weights.shape[1]
            equations.add_all(
                by_pose.reshape(len(places), count, 75) * POSE_SIGMA,
                by_shape.reshape(len(places), count, -1),
                (found - wanted).reshape(len(places), count),
                weights,
            )
            steps = prior.add_to(equations, poses)
            priors = len(places) / FRAMES_PER_PRIOR
            equations.add_shared(np.full(self.space.count, priors), self.coefficients)
            held = 0.0 if proportions else HELD_PRECISION
            equations.hold(np.full(self.space.count, held), 0.0)
            own, shared = equations.solve()
            moved = (steps @ own[..., None])[..., 0]
            moved[:, :72] = np.clip(moved[:, :72], -MAX_TURN_STEP_RAD, MAX_TURN_STEP_RAD)
            poses = poses.moved(moved, still)
            if proportions:
                self.coefficients = self.coefficients + np.clip(shared, -2.0, 2.0)
        return poses

    def _lift(self, places: Float[np.ndarray, "frames points 3"]) -> ClipPoses:
        """First guess of poses: rotations by the limbs, the place by their middle."""
        shaped = self.space.shape(self.coefficients)
        rotations, translations = np.empty((len(places), 24, 3)), np.empty((len(places), 3))
        points = np.zeros((33, 3))
        for frame, found in enumerate(places):
            points[list(PLACED_POINTS)] = found[list(PLACED_JOINTS)]
            pose = lift_pose(points, shaped)
            limbs = shaped.with_pose(pose).joints()[list(PLACED_JOINTS)]
            rotations[frame] = np.concatenate([pose.root_rotation[None], pose.joint_rotations])
            translations[frame] = (found[list(PLACED_JOINTS)] - limbs).mean(axis=0)
        return ClipPoses(rotations=rotation_matrices(rotations), translations=translations)
