"""What the alignment of a capture to its masks changes: body, poses and focal length."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from capture.atomic_files import atomic_file
from capture.input_error import InputError
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.cameras.camera_file import CameraTrack
from preprocess.file_content import read_npz
from preprocess.fitting.clip_fitting import correct_pose


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureFit:
    """What the alignment of a capture changes.

    Attributes:
        coefficients: Proportions, in prior standard deviations.
        focal_factor: Factor of the focal lengths.
        corrections: Correction of each row of the motion: root and joint rotations, root position.
        error_before_cm: Root mean square distance between outlines of body and masks, cm; of poses
            that were made of key points: after a fit to these alone.
        error_after_cm: The same with the changes.
        taken: Whether the changes are made; poses that are exact are left alone.
        fits_body: Whether proportions could change; not those of a finished avatar's person.
    """

    coefficients: Float[np.ndarray, "coefficients"]
    focal_factor: float
    corrections: Float[np.ndarray, "poses 75"]
    error_before_cm: float
    error_after_cm: float
    taken: bool
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
        turned = np.degrees(np.linalg.norm(self.corrections[:, :72].reshape(-1, 24, 3), axis=2))
        return (
            "Body, poses and focal length were fitted to the masks: their outlines were "
            f"{self.error_before_cm:.1f} cm apart and are {self.error_after_cm:.1f} cm apart now "
            f"(the root turned by {turned[:, 0].mean():.1f} degrees on average, other joints by "
            f"{turned[:, 1:].mean():.1f}; focal length times {self.focal_factor:.2f})."
        )

    def as_json(self) -> dict[str, float | bool]:
        """Figures for the report."""
        return {
            "taken": self.taken,
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
    scalars = ("focal_factor", "error_before_cm", "error_after_cm", "taken", "fits_body")
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
