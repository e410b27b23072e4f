"""Joint alignment of a person's proportions, the focal length and a clip's poses to its masks.

A tracker's poses are off by several degrees and centimetres, slowly varying and partly constant;
its body has other proportions than the person, and the focal length is a guess. All of it is fitted
at once by Gauss-Newton: residuals are distances between outlines (`preprocess.fitting.outlines`),
priors hold what outlines leave undetermined, and corrections of neighboring frames are alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.normal_equations import ChainEquations
from preprocess.fitting.outlines import OutlineDistances, OutlineModel

SIGMA_OUTLINE_PX = 1.0
"""Standard deviation of an outline's distance, px of the reduced masks."""
INDEPENDENT_ROWS = 60.0
"""Independent distances along one outline; neighbors on it err alike."""
FRAMES_PER_PRIOR = 10.0
"""Frames of one person that count as one for the proportions: their clothes err alike."""
SIGMA_ROOT_RAD = 0.12
"""Prior standard deviation of the root's rotation, radians."""
SIGMA_SIDE_M = 0.05
"""Prior standard deviation of the root's position across the view, metres."""
SIGMA_DEPTH_M = 0.25
"""Prior standard deviation of the root's distance, metres."""
SIGMA_LOG_FOCAL = 0.08
"""Prior standard deviation of the logarithm of the focal length."""
JOINT_SIGMAS_RAD = (
    (0.10, (1, 2)), (0.10, (4, 5)), (0.08, (7, 8)), (0.01, (10, 11)), (0.04, (3, 6, 9)),
    (0.07, (12, 15)), (0.05, (13, 14)), (0.12, (16, 17)), (0.12, (18, 19)), (0.08, (20, 21)),
    (0.01, (22, 23)),
)  # fmt: skip
"""Prior standard deviation of joints' rotations, radians: of hips, knees, ankles, toes, spine, neck
and head, collars, shoulders, elbows, wrists and hands."""
CHANGE_PER_FRAME = 0.15
"""Standard deviation of a correction's change from a frame to the next, in prior standard
deviations; over n frames it grows with the root of n."""
MAX_POSE_STEP = 0.25
"""Largest change of a parameter of a pose in one iteration, radians or metres."""
MAX_LOG_FOCAL_STEP = 0.05
"""Largest change of the logarithm of the focal length in one iteration."""
HELD_PRECISION = 1e9
"""Precision that holds a parameter that is not fitted."""


def _pose_sigma() -> Float[np.ndarray, "75"]:
    sigma = np.zeros((25, 3))
    sigma[0] = SIGMA_ROOT_RAD
    for value, joints in JOINT_SIGMAS_RAD:
        sigma[list(joints)] = value
    sigma[24] = SIGMA_SIDE_M, SIGMA_SIDE_M, SIGMA_DEPTH_M
    return sigma.ravel()


POSE_SIGMA = _pose_sigma()
"""Prior standard deviation of a frame's correction: root and joint rotations, root position."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ClipFrame:
    """A frame whose mask is fitted.

    Attributes:
        row: Row of the motion.
        number: Frame number.
        mask: Outline of its mask.
    """

    row: int
    number: float
    mask: OutlineDistances


class FitParameters(NamedTuple):
    """Which parameters an iteration fits."""

    poses: bool = True
    proportions: bool = True
    focal: bool = True


ALL_PARAMETERS = FitParameters()
"""Poses, proportions and focal length together."""


@final
class ClipFitter:
    """The parameters of one clip's alignment, and its Gauss-Newton iterations.

    Attributes:
        frames: The frames that are fitted, in time order.
        model: The person.
        coefficients: Proportions, in prior standard deviations.
        log_focal: Logarithm of the focal length's factor.
        corrections: Root rotation, joint rotations (radians, in their joints' axes) and root
            position (metres, in the camera's axes) of each frame.
    """

    def __init__(self, motion: Motion, space: ProportionSpace, frames: Sequence[ClipFrame]) -> None:
        """Starts with the poses, the proportions and the focal length as they are."""
        self._motion = motion
        self.frames = tuple(frames)
        self.model = OutlineModel(space)
        self.coefficients = np.zeros(space.count)
        self.log_focal = 0.0
        self.corrections = np.zeros((len(self.frames), 75))
        gaps = np.maximum(np.diff([frame.number for frame in self.frames]), 1.0)
        links = 1.0 / (CHANGE_PER_FRAME**2 * gaps)
        self._links = np.repeat(links[:, None], 75, axis=1)

    def camera(self, index: int) -> Camera:
        """Camera of a frame, with the present focal length."""
        camera, factor = self.frames[index].mask.camera, float(np.exp(self.log_focal))
        return replace(camera, focal_px=(camera.focal_px[0] * factor, camera.focal_px[1] * factor))

    def pose(self, index: int) -> BodyPose:
        """Present pose of a frame."""
        frame = self.frames[index]
        return correct_pose(
            self._motion[frame.row], self.corrections[index], frame.mask.camera.camera_from_world
        )

    def iterate(self, fitted: FitParameters = ALL_PARAMETERS) -> float:
        """Makes one Gauss-Newton step.

        Args:
            fitted: Which parameters may change.

        Returns:
            Root mean square distance of the outlines before the step, px; robustly weighted.
        """
        equations, error = self._linearise()
        self._add_priors(equations, fitted)
        moved, step = equations.solve()
        self.corrections += np.clip(moved * POSE_SIGMA, -MAX_POSE_STEP, MAX_POSE_STEP)
        self.coefficients += np.clip(step[:-1], -1.0, 1.0)
        self.log_focal += float(
            np.clip(step[-1] * SIGMA_LOG_FOCAL, -MAX_LOG_FOCAL_STEP, MAX_LOG_FOCAL_STEP)
        )
        self.model.set_proportions(self.coefficients)
        return error

    def error_px(self) -> float:
        """Root mean square distance of the outlines, px of the reduced masks."""
        return self._linearise()[1]

    def _linearise(self) -> tuple[ChainEquations, float]:
        """The outlines' equations in prior standard deviations, and their present error, px."""
        equations = ChainEquations.empty(len(self.frames), 75, len(self.coefficients) + 1)
        squares = total = 0.0
        for index, frame in enumerate(self.frames):
            mask = replace(frame.mask, camera=self.camera(index))
            seen = self.model.compare(self.pose(index), mask)
            if seen is None:
                continue
            weight = seen.weights * (INDEPENDENT_ROWS / SIGMA_OUTLINE_PX**2 / len(seen.weights))
            squares += float(weight @ seen.residuals**2)
            total += float(weight.sum())
            shared = np.column_stack([seen.shape_jacobian, SIGMA_LOG_FOCAL * seen.focal_jacobian])
            equations.add(index, seen.pose_jacobian * POSE_SIGMA, shared, seen.residuals, weight)
        return equations, float(np.sqrt(squares / max(total, 1e-9)))

    def _add_priors(self, equations: ChainEquations, fitted: FitParameters) -> None:
        """Adds the priors of all parameters, and holds those that are not fitted."""
        equations.add_chain(self.corrections / POSE_SIGMA, self._links)
        precision = np.full(len(self.coefficients) + 1, 1.0)
        precision *= max(1.0, len(self.frames) / FRAMES_PER_PRIOR)
        state = np.concatenate([self.coefficients, [self.log_focal / SIGMA_LOG_FOCAL]])
        equations.add_shared(precision, state)
        held = np.zeros(len(state))
        held[:-1] = 0.0 if fitted.proportions else HELD_PRECISION
        held[-1] = 0.0 if fitted.focal else HELD_PRECISION
        equations.hold(held, 0.0 if fitted.poses else HELD_PRECISION)


def correct_pose(
    pose: BodyPose,
    correction: Float[np.ndarray, "75"],
    camera_from_world: Float[np.ndarray, "4 4"],
) -> BodyPose:
    """A pose with a correction: rotations in the joints' axes, translation in the camera's."""
    given = Rotation.from_rotvec(np.concatenate([pose.root_rotation[None], pose.joint_rotations]))
    turned = (given * Rotation.from_rotvec(correction[:72].reshape(24, 3))).as_rotvec()
    return BodyPose(
        root_rotation=turned[0],
        root_translation=pose.root_translation + correction[72:] @ camera_from_world[:3, :3],
        joint_rotations=turned[1:],
    )
