"""Joint alignment of a person's proportions, the focal length and a clip's poses to its masks.

A tracker's poses are off by several degrees and centimetres, slowly varying and partly constant;
its body has other proportions than the person, and the focal length is a guess. All of it is fitted
at once by Gauss-Newton: residuals are distances between outlines (`preprocess.fitting.outlines`),
priors hold what outlines leave undetermined, and corrections of neighboring frames are alike.
What a fit changes of a capture is a `CaptureFit`, which is saved with a run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.atomic_files import atomic_file
from capture.camera import Camera
from capture.input_error import InputError
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.cameras.camera_file import CameraTrack
from preprocess.file_content import read_npz
from preprocess.fitting.clip_poses import POSE_SIGMA, ClipPoses, GivenPosePrior, HumanPosePrior
from preprocess.fitting.keypoint_rows import ClipCameras, ClipKeypoints, KeypointModel
from preprocess.fitting.normal_equations import ChainEquations
from preprocess.fitting.outlines import OutlineDistances, OutlineModel
from preprocess.tracking.keypoints import KeypointTrack

SIGMA_OUTLINE_PX = 1.0
"""Standard deviation of an outline's distance, px of the reduced masks."""
FRAMES_PER_PRIOR = 10.0
"""Frames of one person that count as one for the proportions: their clothes err alike."""
SIGMA_LOG_FOCAL = 0.08
"""Prior standard deviation of the logarithm of a stated focal length."""
SIGMA_LOG_ASSUMED_FOCAL = 0.3
"""The same of one that is merely assumed, in a recording or in the first frames of a stream."""
MAX_TURN_STEP_RAD = 0.25
"""Largest change of a rotation's component in one iteration, radians."""
MAX_PLACE_STEP_M = 0.5
"""Largest change of the root's place in one iteration, metres."""
MAX_LOG_FOCAL_STEP = 0.1
"""Largest change of the logarithm of the focal length in one iteration."""
USUAL_FPS = 30.0
"""Frames per second of a film that does not say."""
MAX_USUAL_TURN_DEG = 5.0
"""Mean rotation by which the fit changes joints of usual given poses, degrees. From poses that it
changed by 3, avatars were better than from the built-in tracker's; from such of 7 worse, by 2 dB
on held-out frames."""
HELD_PRECISION = 1e9
"""Precision that holds a parameter that is not fitted."""


class EvidenceWeights(NamedTuple):
    """What a clip's evidence counts against its priors.

    Attributes:
        outline_rows: Independent distances along one outline; neighbors on it err alike.
        keypoints: Factor of the key points' precision in the picture, where an outline tells the
            pose, too.
    """

    outline_rows: float = 60.0
    keypoints: float = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class ClipFrame:
    """A frame whose pose is fitted.

    Attributes:
        row: Row of the motion.
        number: Frame number.
        camera: Its camera, of the reduced masks' size.
        mask: Outline of its mask; None if it is not compared.
    """

    row: int
    number: float
    camera: Camera
    mask: OutlineDistances | None = None


class FitParameters(NamedTuple):
    """Which parameters and which evidence an iteration takes."""

    poses: bool = True
    proportions: bool = True
    focal: bool = True
    outlines: bool = True


USUAL_WEIGHTS = EvidenceWeights()
"""Where proportions are fitted to few frames, or poses are given."""
TRACKED_WEIGHTS = EvidenceWeights(outline_rows=120.0, keypoints=0.3)
"""Outlines tell where limbs are better than key points, which are off by 2 cm for many frames."""
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
        poses: Present poses of the frames.
        weights: What outlines and key points count; may be changed between iterations.
    """

    def __init__(
        self,
        motion: Motion,
        space: ProportionSpace,
        frames: Sequence[ClipFrame],
        *,
        track: KeypointTrack | None = None,
        settled: bool = False,
        sigma_log_focal: float = SIGMA_LOG_FOCAL,
        frames_per_prior: float = FRAMES_PER_PRIOR,
        weights: EvidenceWeights = USUAL_WEIGHTS,
        model: OutlineModel | None = None,
    ) -> None:
        """Starts with the poses, the proportions and the focal length as they are.

        Args:
            motion: The poses to start from.
            space: Proportions around the present person.
            frames: The frames to fit, in time order.
            track: Key points, as further evidence. With them the poses are merely human; without,
                they are near the motion's.
            settled: Whether these poses were fitted to key points before.
            sigma_log_focal: How uncertain the focal length is.
            frames_per_prior: Frames that count as one for the proportions.
            weights: What outlines and key points count.
            model: The person at the space's origin, where several clips share it.
        """
        self.frames = tuple(frames)
        self.model = model or OutlineModel(space)
        self._keypoint_model = KeypointModel(space)
        seen = sum(frame.mask is not None for frame in frames) if track is None else len(frames)
        self._priors, self.weights = max(1.0, seen / frames_per_prior), weights
        self.coefficients = np.zeros(space.count)
        self.log_focal, self._sigma_log_focal = 0.0, sigma_log_focal
        self._given = ClipPoses.of(motion, [frame.row for frame in self.frames])
        self.poses = self._given
        self._turns = np.stack([each.camera.camera_from_world[:3, :3] for each in self.frames])
        numbers = np.array([frame.number for frame in self.frames])
        self._keypoints: ClipKeypoints | None = None
        if track is None:
            self._prior = GivenPosePrior(self._given, self._turns, numbers)
        else:
            cameras = [frame.camera for frame in self.frames]
            used = [int(frame.number) for frame in self.frames]
            self._keypoints = ClipKeypoints.of(track, used, cameras, space.shaped.joints)
            self._prior = HumanPosePrior(self._turns, _times_s(track, numbers), settled=settled)

    @property
    def corrections(self) -> Float[np.ndarray, "frames 75"]:
        """Correction of each frame: root and joint rotations (radians, in their joints' axes) and
        root position (metres, in the camera's axes).
        """
        return self.poses.steps_from(self._given, self._turns)

    def camera(self, index: int) -> Camera:
        """Camera of a frame, with the present focal length."""
        return self.frames[index].camera.scale_focal(float(np.exp(self.log_focal)))

    def pose(self, index: int) -> BodyPose:
        """Present pose of a frame."""
        return self.poses[index]

    def iterate(self, fitted: FitParameters = ALL_PARAMETERS) -> float:
        """Makes one Gauss-Newton step.

        Args:
            fitted: Which parameters may change.

        Returns:
            Root mean square distance of the outlines before the step, px; robustly weighted.
        """
        equations, error = self._linearise(fitted)
        steps = self._add_priors(equations, fitted)
        found, step = equations.solve()
        moved = (steps @ found[..., None])[..., 0]
        zoom = float(step[-1] * self._sigma_log_focal)
        zoomed = float(np.clip(zoom, -MAX_LOG_FOCAL_STEP, MAX_LOG_FOCAL_STEP))
        moved[:, 74] -= (zoom - zoomed) * self._depths_m()  # distances go with the focal length
        moved[:, :72] = np.clip(moved[:, :72], -MAX_TURN_STEP_RAD, MAX_TURN_STEP_RAD)
        moved[:, 72:] = np.clip(moved[:, 72:], -MAX_PLACE_STEP_M, MAX_PLACE_STEP_M)
        self.poses = self.poses.moved(moved, self._turns)
        if fitted.proportions:
            self.coefficients += np.clip(step[:-1], -1.0, 1.0)
            self.model.set_proportions(self.coefficients)
        self.log_focal += zoomed
        return error

    def _depths_m(self) -> Float[np.ndarray, "frames"]:
        """Distance of each frame's root along the view."""
        views = np.stack([frame.camera.camera_from_world[2] for frame in self.frames])
        places = self.model.joints[0] + self.poses.translations
        return (views[:, :3] * places).sum(axis=1) + views[:, 3]

    def _linearise(self, fitted: FitParameters) -> tuple[ChainEquations, float]:
        """The evidence's equations in prior standard deviations; the outlines' error, px."""
        equations = ChainEquations.empty(len(self.frames), 75, len(self.coefficients) + 1)
        squares = total = 0.0
        rest, parents = self.model.joints, self.model.space.shaped.body.parents
        carried = self.poses.joints(rest, parents).world_from_rest(rest)
        for index, frame in enumerate(self.frames):
            if frame.mask is None or not fitted.outlines:
                continue
            mask = replace(frame.mask, camera=self.camera(index))
            seen = self.model.compare(carried[index], mask, proportions=fitted.proportions)
            if seen is None:
                continue
            precision = self.weights.outline_rows / SIGMA_OUTLINE_PX**2
            weight = seen.weights * (precision / len(seen.weights))
            squares += float(weight @ seen.residuals**2)
            total += float(weight.sum())
            shared = np.column_stack(
                [seen.shape_jacobian, self._sigma_log_focal * seen.focal_jacobian]
            )
            equations.add(index, seen.pose_jacobian * POSE_SIGMA, shared, seen.residuals, weight)
        self._add_keypoints(equations, fitted.outlines)
        return equations, float(np.sqrt(squares / max(total, 1e-9)))

    def _add_keypoints(self, equations: ChainEquations, outlines: bool) -> None:
        """Adds the key points of all frames."""
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
        focal = self._sigma_log_focal * seen.focal_jacobian[..., None]
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

        Returns:
            The poses' steps by the parameters that the equations then have.
        """
        steps = self._prior.add_to(equations, self.poses)
        precision = np.full(len(self.coefficients) + 1, self._priors)
        state = np.concatenate([self.coefficients, [self.log_focal / self._sigma_log_focal]])
        equations.add_shared(precision, state)
        held = np.zeros(len(state))
        held[:-1] = 0.0 if fitted.proportions else HELD_PRECISION
        held[-1] = 0.0 if fitted.focal else HELD_PRECISION
        equations.hold(held, 0.0 if fitted.poses else HELD_PRECISION)
        return steps


def _times_s(
    track: KeypointTrack, numbers: Float[np.ndarray, "frames"]
) -> Float[np.ndarray, "frames"]:
    """Times of frames, of which each may lie between those of the key points."""
    if track.times_s is None:
        return numbers / USUAL_FPS
    return np.interp(numbers, track.frames, track.times_s)


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


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureFit:
    """What the alignment of a capture changes.

    Attributes:
        coefficients: Proportions, in prior standard deviations.
        focal_factor: Factor of the focal lengths.
        corrections: Correction of each row of the motion: root and joint rotations, root position.
        error_before_cm: Root mean square distance between outlines of body and masks, cm; of poses
            that were made of key points: after a fit to these alone.
        error_after_cm: The same with the whole of the changes.
        share: Share of the changes that is made, in [0, 1], and how far the given poses are
            estimates: none where they are exact, 1 where they were made of key points.
        fits_body: Whether proportions could change; not those of a finished avatar's person.
    """

    coefficients: Float[np.ndarray, "coefficients"]
    focal_factor: float
    corrections: Float[np.ndarray, "poses 75"]
    error_before_cm: float
    error_after_cm: float
    share: float
    fits_body: bool

    def shape(self, shaped: ShapedBody) -> ShapedBody:
        """The person, with fitted proportions."""
        return ProportionSpace.around(shaped).shape(self.coefficients)

    def scale_focal_lengths(self, cameras: CameraTrack) -> CameraTrack:
        """The cameras, with the fitted focal length."""
        return cameras.scale_focal(self.focal_factor)

    def correct_motion(self, geometry: CaptureGeometry) -> Motion:
        """The motion of the geometry that was fitted, with a correction of each row."""
        motion, cameras = geometry.motion, geometry.camera_rows()
        poses = [
            correct_pose(motion[row], self.corrections[row], geometry.extrinsics[cameras[row]])
            for row in range(len(motion))
        ]
        return replace(
            motion,
            root_rotations=np.stack([pose.root_rotation for pose in poses]),
            root_translations=np.stack([pose.root_translation for pose in poses]),
            joint_rotations=np.stack([pose.joint_rotations for pose in poses]),
        )

    def describe(self) -> str:
        """Describe the changes, for people."""
        turned = self._mean_turns_deg()
        return (
            "Body, poses and focal length were fitted to the masks: their outlines were "
            f"{self.error_before_cm:.1f} cm apart, and {self.error_after_cm:.1f} cm by the fit, of "
            f"which {self.share:.0%} was made (the root turned by {turned[0]:.1f} "
            f"degrees on average, other joints by {turned[1:].mean():.1f}; focal length times "
            f"{self.focal_factor:.2f})."
        )

    def advice(self) -> str | None:
        """Say that the given poses were far from the film; None if they were not."""
        turn_deg = self._mean_turns_deg()[1:].mean()
        if turn_deg <= MAX_USUAL_TURN_DEG:
            return None
        return (
            f"The given poses disagree with the film: joints had to turn by {turn_deg:.1f} degrees "
            "on average, those of good trackers by 2 to 4. The built-in tracker is likely nearer: "
            "try it without --poses (and with the poses' file out of the video's folder)."
        )

    def _mean_turns_deg(self) -> Float[np.ndarray, "24"]:
        """Mean rotation of the root and of each joint, degrees."""
        vectors = self.corrections[:, :72].reshape(-1, 24, 3)
        return np.degrees(np.linalg.norm(vectors, axis=2)).mean(axis=0)

    def as_json(self) -> dict[str, float | bool]:
        """Figures for the report."""
        return {
            "taken": self.share > 0.0,
            "share": round(self.share, 3),
            "outline_cm_before": round(self.error_before_cm, 3),
            "outline_cm_after": round(self.error_after_cm, 3),
            "focal_factor": round(self.focal_factor, 4),
        }

    def save(self, path: Path, video: str) -> None:
        """Write the changes, for a run that is resumed.

        Args:
            path: File, .npz.
            video: What identifies the capture's video.
        """
        with atomic_file(path) as unfinished:
            np.savez(unfinished, **vars(self), video=video)


def load_capture_fit(path: Path, video: str) -> CaptureFit | None:
    """Read what `CaptureFit.save` wrote; None if there is nothing for this video."""
    if not path.is_file():
        return None
    scalars = ("focal_factor", "error_before_cm", "error_after_cm", "share", "fits_body")
    try:
        read = read_npz(path, ("coefficients", "corrections", "video", *scalars))
        if str(read["video"]) != video:
            return None
        return CaptureFit(
            coefficients=read["coefficients"],
            corrections=read["corrections"],
            **{name: read[name].item() for name in scalars},
        )
    except (InputError, KeyError):
        return None
