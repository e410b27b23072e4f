"""The changes that the alignment of a capture makes: saved with a run, and described for people."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.atomic_files import atomic_file
from capture.input_error import InputError
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.file_content import read_npz
from preprocess.fitting.clip_poses import ClipPoses


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureFit:
    """The changes that the alignment of a capture makes.

    Attributes:
        coefficients: Proportions, in prior standard deviations.
        corrections: Correction of each row of the motion: root and joint rotations, root position.
        error_before_cm: Root mean square distance between outlines of body and masks, cm; of poses
            that were made of key points: after a fit to these alone.
        error_after_cm: The same before the fit's last iteration, with the whole of the changes.
        share: Share of the changes that is made, in [0, 1], and how far the given poses are
            estimates: none where they are exact, 1 where they were made of key points.
        keypoint_share: Mean weight of joints by the built-in tracker's key points beside the given
            ones, in [0, 1]: 0 where given poses are exact, or were made of key points themselves.
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

    def correct_motion(self, geometry: CaptureGeometry) -> Motion:
        """The motion of the geometry that was fitted, with a correction of each row."""
        motion, views = geometry.motion, geometry.extrinsics[geometry.camera_rows()]
        poses = ClipPoses.of(motion, range(len(motion)))
        return poses.moved(self.corrections, views[:, :3, :3]).replace_in(motion)

    def describe(self) -> str:
        """Describe the changes, for people."""
        vectors = self.corrections[:, :72].reshape(-1, 24, 3)
        turned = np.degrees(np.linalg.norm(vectors, axis=2)).mean(axis=0)
        given = ""
        if self.keypoint_share:
            given = (
                f" The given poses count by {1.0 - self.keypoint_share:.0%}, those that the "
                "built-in tracker's key points tell by the rest."
            )
        return (
            "Body, poses and focal length were fitted to the masks: their outlines were "
            f"{self.error_before_cm:.1f} cm apart, and {self.error_after_cm:.1f} cm by the fit, of "
            f"which {self.share:.0%} was made (the root turned by {turned[0]:.1f} "
            f"degrees on average, other joints by {turned[1:].mean():.1f}; focal length times "
            f"{self.focal_factor:.2f}).{given}"
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
    names = [field.name for field in fields(CaptureFit)]
    try:
        read = read_npz(path, (*names, "video"))
        if str(read["video"]) != video:
            return None
        values: dict[str, Any] = {
            name: read[name] if read[name].ndim else read[name].item() for name in names
        }
        return CaptureFit(**values)
    except (InputError, KeyError):
        return None
