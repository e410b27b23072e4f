"""Joint alignment of a person's proportions, the focal length and a clip's poses to its masks.

A tracker's poses are off by several degrees and centimetres, slowly varying and partly constant;
its body has other proportions than the person, and the focal length is a guess. All of it is fitted
at once by Gauss-Newton: residuals are distances between outlines (`preprocess.fitting.outlines`),
priors hold what outlines leave undetermined, and corrections of neighboring frames are alike.
What a fit changes of a capture is a `CaptureFit` (`preprocess.capture_session`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.source import ASSUMED_FPS, Frame
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_poses import POSE_SIGMA, ClipPoses, GivenPosePrior, HumanPosePrior
from preprocess.fitting.keypoint_rows import ClipCameras, ClipKeypoints, KeypointModel
from preprocess.fitting.normal_equations import ChainEquations
from preprocess.fitting.outlines import OutlineDistances, OutlineModel
from preprocess.tracking.keypoints import KeypointTrack

SIGMA_LOG_FOCAL = 0.3
"""Prior standard deviation of the logarithm of the focal length: what files state is often the
tracker's own guess (with 0.08 a stated one stays 1.25 times too short that is 1.38 times so)."""
SIGMA_LOG_LIVE_FOCAL = 0.08
"""The same of a camera file of a stream, whose first frames show the person from one side."""
HELD_PRECISION = 1e9
"""Precision that holds a parameter that is not fitted."""


class EvidenceWeights(NamedTuple):
    """Weights of a clip's evidence against its priors.

    An outline counts as `outline_rows` independent distances, each with a standard deviation of a
    pixel of the reduced masks; `keypoints` is a factor of the key points' precision beside it.
    """

    outline_rows: float = 60.0
    keypoints: float = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class ClipFrame:
    """A frame whose pose is fitted, by its number.

    The camera is of the reduced masks' size; without a mask the frame is not compared with one.
    A picture is there if it was decoded for the mask and kept.
    """

    number: float
    camera: Camera
    mask: OutlineDistances | None = None
    picture: Frame | None = None


class FitParameters(NamedTuple):
    """The parameters and the evidence that an iteration takes."""

    poses: bool = True
    proportions: bool = True
    focal: bool = True
    outlines: bool = True


USUAL_WEIGHTS = EvidenceWeights()
"""Weights where proportions are fitted to few frames, or poses are given."""
TRACKED_WEIGHTS = EvidenceWeights(outline_rows=120.0, keypoints=0.3)
"""Outlines tell where limbs are better than key points, which are off by 2 cm for many frames."""
POSES_ALONE = FitParameters(proportions=False, focal=False)
"""Poses of a person and a camera that stay."""


@final
class ClipFitter:
    """The parameters of one clip's alignment, and its Gauss-Newton iterations.

    Attributes:
        frames: The frames that are fitted, in time order; `numbers` are theirs.
        coefficients: Proportions, in prior standard deviations.
        log_focal: Logarithm of the focal length's factor.
        weights: May be changed between iterations.
        given: The poses from which the fit began.
        camera_rotations: Rotation of each frame's camera, camera from world.
    """

    def __init__(
        self,
        given: ClipPoses,
        space: ProportionSpace,
        frames: Sequence[ClipFrame],
        *,
        track: KeypointTrack | None = None,
        settled: bool = False,
        sigma_log_focal: float = SIGMA_LOG_FOCAL,
        weights: EvidenceWeights = USUAL_WEIGHTS,
        model: OutlineModel | None = None,
    ) -> None:
        """Starts with a pose of each frame, the proportions and the focal length as they are.

        Frames are in time order. With key points (`track`) the poses are merely human, without
        near the given ones. `settled` tells that they were fitted to key points before; several
        clips may share a `model`, the person at the space's origin.
        """
        self.frames = tuple(frames)
        self.model = model or OutlineModel(space)
        self._keypoint_model = KeypointModel(space)
        self.weights = weights
        self.coefficients = np.zeros(space.count)
        self.log_focal, self._sigma_log_focal = 0.0, sigma_log_focal
        self.given = self.poses = given
        self.camera_rotations = np.stack(
            [each.camera.camera_from_world[:3, :3] for each in self.frames]
        )
        self.numbers = np.array([frame.number for frame in self.frames])
        masked = np.flatnonzero([frame.mask is not None for frame in self.frames])
        used = masked if track is None and len(masked) else np.arange(len(self.frames))
        self._priors = len(used) / self.given.rows(used).independent_count(
            space.shaped.joints, self.camera_rotations[used]
        )
        self._keypoints: ClipKeypoints | None = None
        if track is None:
            self.expect(given)
            return
        cameras = [frame.camera for frame in self.frames]
        whole = self.numbers.astype(int).tolist()
        self._keypoints = ClipKeypoints.of(track, whole, cameras, space.shaped.joints)
        times_s = self.numbers / ASSUMED_FPS
        if track.times_s is not None:  # a frame may lie between those with key points
            times_s = np.interp(self.numbers, track.frames, track.times_s)
        self._prior = HumanPosePrior(self.camera_rotations, times_s, settled=settled)

    def expect(self, given: ClipPoses) -> None:
        """Go on near some poses of the frames."""
        self._prior = GivenPosePrior(given, self.camera_rotations, self.numbers)

    def take_person(self, other: "ClipFitter") -> None:
        """Go on with another fit's proportions and focal length; both are around one shape."""
        self.coefficients, self.log_focal = other.coefficients.copy(), other.log_focal
        self.model.set_proportions(self.coefficients)

    @property
    def corrections(self) -> Float[np.ndarray, "frames 75"]:
        """Correction of each frame: root and joint rotations (radians, in their joints' axes) and
        root position (metres, in the camera's axes).
        """
        return self.poses.steps_from(self.given, self.camera_rotations)

    def camera(self, index: int) -> Camera:
        """Camera of a frame, with the present focal length."""
        return self.frames[index].camera.scale_focal(float(np.exp(self.log_focal)))

    def iterate_stages(
        self, fitted: FitParameters, keypoint_count: int, outline_count: int
    ) -> list[float]:
        """Iterates with key points alone, then with outlines; returns errors before the latter."""
        for _ in range(keypoint_count):
            self.iterate(fitted._replace(outlines=False))
        return [self.iterate(fitted) for _ in range(outline_count)]

    def iterate(self, fitted: FitParameters) -> float:
        """Makes one Gauss-Newton step; returns the outlines' robust error before it.

        The error is a root mean square distance, px of the reduced masks.
        """
        equations, error = self._linearise(fitted)
        steps = self._add_priors(equations, fitted)
        found, step = equations.solve()
        moved = (steps @ found[..., None])[..., 0]
        zoom = float(np.clip(step[-1] * self._sigma_log_focal, -0.1, 0.1))
        moved[:, :72] = np.clip(moved[:, :72], -0.25, 0.25)  # radians
        moved[:, 72:] = np.clip(moved[:, 72:], -0.5, 0.5)  # metres
        moved[:, 74] += zoom * self._depths_m(self.poses)  # distances go with the focal length
        self.poses = self.poses.moved(moved, self.camera_rotations)
        if fitted.proportions:
            self.coefficients += np.clip(step[:-1], -1.0, 1.0)
            self.model.set_proportions(self.coefficients)
        self.log_focal += zoom
        return error

    def _depths_m(self, poses: ClipPoses) -> Float[np.ndarray, "frames"]:
        """Distance of each frame's root along the view."""
        views = np.stack([frame.camera.camera_from_world[2] for frame in self.frames])
        places = self.model.joints[0] + poses.translations
        return (views[:, :3] * places).sum(axis=1) + views[:, 3]

    def as_stated(self, poses: ClipPoses) -> ClipPoses:
        """Poses at the distances at which the stated focal length shows them as large."""
        nearer = np.zeros((len(self.frames), 75))
        nearer[:, 74] = np.expm1(-self.log_focal) * self._depths_m(poses)
        return poses.moved(nearer, self.camera_rotations)

    def _linearise(self, fitted: FitParameters) -> tuple[ChainEquations, float]:
        """The evidence's equations in prior standard deviations; the outlines' error, px."""
        equations = ChainEquations.empty(len(self.frames), 75, len(self.coefficients) + 1)
        squares = total = 0.0
        depths = self._depths_m(self.poses)
        rest, parents = self.model.joints, self.model.space.shaped.body.parents
        carried = self.poses.joints(rest, parents).world_from_rest(rest)
        for index, frame in enumerate(self.frames):
            if frame.mask is None or not fitted.outlines:
                continue
            mask = replace(frame.mask, camera=self.camera(index))
            seen = self.model.compare(carried[index], mask, proportions=fitted.proportions)
            if seen is None:
                continue
            weight = seen.weights * (self.weights.outline_rows / len(seen.weights))
            squares += float(weight @ seen.residuals**2)
            total += float(weight.sum())
            zoomed = seen.focal_jacobian + depths[index] * seen.pose_jacobian[:, 74]
            shared = np.column_stack([seen.shape_jacobian, self._sigma_log_focal * zoomed])
            equations.add(index, seen.pose_jacobian * POSE_SIGMA, shared, seen.residuals, weight)
        self._add_keypoints(equations, fitted.outlines)
        return equations, float(np.sqrt(squares / max(total, 1e-9)))

    def _add_keypoints(self, equations: ChainEquations, outlines: bool) -> None:
        if self._keypoints is None:
            return
        outlined = [outlines and frame.mask is not None for frame in self.frames]
        cameras = [self.camera(index) for index in range(len(self.frames))]
        seen = self._keypoint_model.compare(
            self.poses,
            self.model.joints,
            ClipCameras.of(cameras),
            self._keypoints,
            np.where(outlined, self.weights.keypoints, 1.0),
        )
        depths = self._depths_m(self.poses)[:, None]
        zoomed = seen.focal_jacobian + depths * seen.pose_jacobian[..., 74]
        focal = self._sigma_log_focal * zoomed[..., None]
        equations.add_all(
            seen.pose_jacobian * POSE_SIGMA,
            np.concatenate([seen.shape_jacobian, focal], axis=-1),
            seen.residuals,
            seen.weights,
        )

    def _add_priors(
        self, equations: ChainEquations, fitted: FitParameters
    ) -> Float[np.ndarray, "frames 75 75"]:
        """Adds the priors of all parameters, and holds those that are not fitted.

        Returns the poses' steps by the parameters that the equations then have.
        """
        steps = self._prior.add_to(equations, self.as_stated(self.poses))
        precision = np.full(len(self.coefficients) + 1, self._priors)
        state = np.concatenate([self.coefficients, [self.log_focal / self._sigma_log_focal]])
        equations.add_shared(precision, state)
        held = np.zeros(len(state))
        held[:-1] = 0.0 if fitted.proportions else HELD_PRECISION
        held[-1] = 0.0 if fitted.focal else HELD_PRECISION
        equations.hold(held, 0.0 if fitted.poses else HELD_PRECISION)
        return steps
