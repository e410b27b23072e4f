"""The changes that the alignment of a capture makes: saved with a run, and described for people."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.atomic_files import atomic_file
from capture.input_error import InputError
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.cameras.camera_file import CameraTrack
from preprocess.file_content import read_npz


def correct_pose(
    pose: BodyPose, correction: Float[np.ndarray, "75"], camera_from_world: Float[np.ndarray, "4 4"]
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
    """The changes that the alignment of a capture makes.

    Attributes:
        coefficients: Proportions, in prior standard deviations.
        corrections: Correction of each row of the motion: root and joint rotations, root position.
        error_before_cm: Root mean square distance between outlines of body and masks, cm; of poses
            that were made of key points: after a fit to these alone.
        error_after_cm: The same with the whole of the changes.
        share: Share of the changes that is made, in [0, 1], and how far the given poses are
            estimates: none where they are exact, 1 where they were made of key points.
        keypoint_share: Weight of poses by the built-in tracker's key points beside the given ones,
            in [0, 1]: 0 where given poses are exact, or were made of key points themselves.
        fits_body: Whether proportions could change; not those of a finished avatar's person.
    """

    coefficients: Float[np.ndarray, "coefficients"]
    focal_factor: float
    corrections: Float[np.ndarray, "poses 75"]
    error_before_cm: float
    error_after_cm: float
    share: float
    keypoint_share: float
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
        vectors = self.corrections[:, :72].reshape(-1, 24, 3)
        turned = np.degrees(np.linalg.norm(vectors, axis=2)).mean(axis=0)
        return (
            "Body, poses and focal length were fitted to the masks: their outlines were "
            f"{self.error_before_cm:.1f} cm apart, and {self.error_after_cm:.1f} cm by the fit, of "
            f"which {self.share:.0%} was made (the root turned by {turned[0]:.1f} "
            f"degrees on average, other joints by {turned[1:].mean():.1f}; focal length times "
            f"{self.focal_factor:.2f}).{self._describe_keypoints()}"
        )

    def _describe_keypoints(self) -> str:
        if not self.keypoint_share:
            return ""
        return (
            f" The given poses count by {1.0 - self.keypoint_share:.0%}, those that the built-in "
            "tracker's key points tell by the rest."
        )

    def as_json(self) -> dict[str, float | bool]:
        """Figures for the report."""
        return {
            "taken": self.share > 0.0,
            "share": round(self.share, 3),
            "keypoint_share": round(self.keypoint_share, 3),
            "outline_cm_before": round(self.error_before_cm, 3),
            "outline_cm_after": round(self.error_after_cm, 3),
            "focal_factor": round(self.focal_factor, 4),
        }

    def save(self, path: Path, video: str) -> None:
        """Write the changes, for a run that is resumed; `video` identifies the capture's video."""
        with atomic_file(path) as unfinished:
            np.savez(unfinished, **vars(self), video=video)


def load_capture_fit(path: Path, video: str) -> CaptureFit | None:
    """Read what `CaptureFit.save` wrote; None if there is nothing for this video."""
    if not path.is_file():
        return None
    scalars = (
        "focal_factor",
        "error_before_cm",
        "error_after_cm",
        "share",
        "keypoint_share",
        "fits_body",
    )
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
