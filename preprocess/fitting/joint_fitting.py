"""Fit of our body to the joints of another one: proportions of a person, and poses over time.

Bodies differ in how their joints rest and turn, but all say where hips, knees and wrists are. Our
joints are brought there by Gauss-Newton; what places leave open (twists, the spine's curve) follows
from knuckles, eyes and toes where they are known, from what is human, and from neighboring frames.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from capture.source import ASSUMED_FPS
from preprocess.body.kinematics import JOINT_NAMES, JointPlaces, rotation_matrices
from preprocess.body.parametric_body import load_body_model
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_poses import POSE_SIGMA, ClipPoses, GivenPosePrior, HumanPosePrior
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
    (0.004, (1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21)), (0.006, (10, 11)),
    (0.008, (0, 3, 6, 9, 12, 13, 14, 15)), (0.02, (22, 23)),
)  # fmt: skip
"""Standard deviation between joints of the same name of two bodies, metres: limbs, toes, the
trunk's, which depend most on the person, and hands."""
SAME_JOINTS = np.zeros((24, 3))
"""Offsets of a body that has its joints where ours has them."""
COMPARED_JOINTS = tuple(range(22))
"""Joints whose distance is stated: all but the hands, which bodies have in different places."""


class FittedJoints(NamedTuple):
    """Poses and proportions of our body.

    Attributes:
        poses: One a row.
        coefficients: Proportions around the mean of the embedded body.
        distances_m: Distance of each compared joint in each row from the track's; NaN where that
            is unknown.
    """

    poses: ClipPoses
    coefficients: Float[np.ndarray, "coefficients"]
    distances_m: Float[np.ndarray, "rows compared"]


def rows_with_limbs(places: Float[np.ndarray, "rows points 3"]) -> Int[np.ndarray, "some"]:
    """Rows that have all shoulders, elbows, wrists, hips, knees, ankles; a ValueError if none."""
    rows = np.flatnonzero(np.isfinite(places[:, list(PLACED_JOINTS)]).all(axis=(1, 2)))
    if not len(rows):
        raise ValueError("no frame has all shoulders, elbows, wrists, hips, knees and ankles")
    return rows


def fit_joints(
    places: Float[np.ndarray, "rows points 3"],
    times_s: Float[np.ndarray, "rows"],
    turns: Float[np.ndarray, "rows 24 3 3"] | None = None,
    offsets_m: JointPlaces = SAME_JOINTS,
) -> FittedJoints:
    """Fit the embedded body to the joints of another one over time.

    Places are those of `POINT_NAMES`, NaN where unknown, but not of limbs. The fit stays near world
    rotations since SMPL's T-pose, if known; offsets are those of the other body's joints from ours.
    """
    fitter = _JointFitter(places, times_s, turns, offsets_m)
    count = len(places)
    keys = np.unique(np.linspace(0, count - 1, 60).round().astype(int))
    fitter.fit(keys, proportions=True)
    parts = [
        fitter.fit(some, proportions=False)
        for some in np.array_split(np.arange(count), -(-count // 300))  # at most 300 at once
    ]
    poses = ClipPoses(
        rotations=np.concatenate([part.rotations for part in parts]),
        translations=np.concatenate([part.translations for part in parts]),
    )
    joints = poses.joints(fitter.rest_joints, fitter.space.shaped.body.parents)
    found = joints.places + (joints.turns @ offsets_m[:, :, None])[..., 0]
    compared = list(COMPARED_JOINTS)
    apart = np.linalg.norm(found[:, compared] - places[:, compared], axis=-1)
    return FittedJoints(poses, fitter.coefficients, apart)


class _JointFitter:
    """The embedded body, whose proportions are fitted once and then stay."""

    def __init__(
        self,
        places: Float[np.ndarray, "rows points 3"],
        times_s: Float[np.ndarray, "rows"],
        turns: Float[np.ndarray, "rows 24 3 3"] | None,
        offsets_m: JointPlaces,
    ) -> None:
        self._places, self._times, self._turns = places, times_s, turns
        self.space = ProportionSpace.around(load_body_model().with_shape())
        self.coefficients = np.zeros(self.space.count)
        numbers = list(LANDMARKS.values())
        joints = np.concatenate([np.arange(24), KEYPOINT_JOINTS[numbers]])
        offsets = np.concatenate([offsets_m, KEYPOINT_OFFSETS_M[numbers]])
        self._attached = AttachedPoints(self.space, joints, offsets)
        sigma = np.full(len(POINT_NAMES), 0.012)  # metres, of landmarks
        for value, some in JOINT_SIGMAS_M:
            sigma[list(some)] = value
        self._precision = sigma**-2

    @property
    def rest_joints(self) -> JointPlaces:
        """Rest joints of the present proportions, metres."""
        return self.space.shaped.joints + self.space.joint_directions @ self.coefficients

    def fit(self, rows: Int[np.ndarray, "rows"], *, proportions: bool) -> ClipPoses:
        """Fit the poses of some rows, and perhaps the proportions."""
        places, times_s = self._places[rows], self._times[rows]
        poses = self._start(places, None if self._turns is None else self._turns[rows])
        known = np.isfinite(places).all(axis=-1)
        weights = np.repeat(known * self._precision, 3, axis=1)
        wanted = np.nan_to_num(places)
        still = np.broadcast_to(np.eye(3), (len(poses.rotations), 3, 3))
        prior = HumanPosePrior(still, times_s, settled=True)
        if self._turns is not None:
            prior = GivenPosePrior(poses, still, ASSUMED_FPS * times_s)
        for _ in range(12 if proportions else 6):
            fitted = self.space.count if proportions else 0
            equations = ChainEquations.empty(len(places), 75, fitted)
            found, by_pose, by_shape = self._attached.place(
                poses, self.rest_joints, still, np.zeros((len(places), 3))
            )
            shape = weights.shape
            equations.add_all(
                by_pose.reshape(*shape, 75) * POSE_SIGMA,
                by_shape.reshape(*shape, -1)[..., :fitted],
                (found - wanted).reshape(shape),
                weights,
            )
            steps = prior.add_to(equations, poses)
            equations.add_shared(np.full(fitted, float(len(places))), self.coefficients[:fitted])
            own, shared = equations.solve()
            moved = (steps @ own[..., None])[..., 0]
            moved[:, :72] = np.clip(moved[:, :72], -0.5, 0.5)
            poses = poses.moved(moved, still)
            if proportions:
                self.coefficients = self.coefficients + np.clip(shared, -2.0, 2.0)
        return poses

    def _start(
        self,
        places: Float[np.ndarray, "rows points 3"],
        turns: Float[np.ndarray, "rows 24 3 3"] | None,
    ) -> ClipPoses:
        """First guess of poses: rotations as given, or by the limbs; the place by their middle."""
        shaped, points = self.space.shape(self.coefficients), np.zeros((33, 3))
        parents, limbs = shaped.body.parents, list(PLACED_JOINTS)
        if turns is None:
            rotations = np.empty((len(places), 24, 3, 3))
            for row, found in enumerate(places):
                points[list(PLACED_POINTS)] = found[limbs]
                pose = lift_pose(points, shaped)
                rotations[row] = rotation_matrices(
                    np.concatenate([pose.root_rotation[None], pose.joint_rotations])
                )
        else:
            rotations = turns.copy()
            rotations[:, 1:] = turns[:, parents[1:]].swapaxes(-1, -2) @ turns[:, 1:]
        poses = ClipPoses(rotations=rotations, translations=np.zeros((len(places), 3)))
        moved = (places[:, limbs] - poses.joints(shaped.joints, parents).places[:, limbs]).mean(1)
        return ClipPoses(rotations=rotations, translations=moved)
