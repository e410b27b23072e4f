"""A mistake in a capture as the change that undoes it, and those mistakes that have a size."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from preprocess.doctor.claim import Claim

CAUSES = (
    "mask_polarity", "world_frame", "opengl_axes", "root_rotation", "frame_offset", "frame_rate",
    "left_right", "root_origin", "focal", "body_scale",
)  # fmt: skip
"""By these names mistakes are called, in commands and files."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cure:
    """One mistake, undone.

    Attributes:
        cause: The mistake, one of `CAUSES`.
        words: What was wrong, for people: ends the sentence "It looks as if …".
        undo: From the claim to what it should have been.
        factor: Of a fitted cure, the number that was fitted.
    """

    cause: str
    words: str
    undo: Callable[[Claim], Claim]
    factor: float | None = None


def shifted(frames: int) -> Cure:
    """Poses that come too late (positive) or too early by some frames."""
    late, other = ("late", "early") if frames > 0 else ("early", "late")
    return Cure(
        cause="frame_offset",
        words=f"the poses come {abs(frames)} frame{'s' if abs(frames) > 1 else ''} too {late} "
        f"(or the masks too {other})",
        undo=lambda c: replace(c, places=c.places - frames),
    )


def refocused(factor: float) -> Cure:
    """Focal lengths that are too short (factor above 1) or too long."""

    def undo(claim: Claim) -> Claim:
        intrinsics = claim.intrinsics.copy()
        intrinsics[:, [0, 1], [0, 1]] *= factor
        return replace(claim, intrinsics=intrinsics)

    wrong = "short" if factor > 1.0 else "long"
    return Cure(
        cause="focal",
        words=f"the focal length is too {wrong}; {factor:.3f} times fits",
        undo=undo,
        factor=factor,
    )


def recentred(right_px: float, down_px: float) -> Cure:
    """Principal points that are so many pixels too far left and up (negative: right and down)."""

    def undo(claim: Claim) -> Claim:
        intrinsics = claim.intrinsics.copy()
        intrinsics[:, :2, 2] += np.array([right_px, down_px])
        return replace(claim, intrinsics=intrinsics)

    sides = (
        f"{abs(right_px):.0f} px too far {'left' if right_px > 0.0 else 'right'}",
        f"{abs(down_px):.0f} px too far {'up' if down_px > 0.0 else 'down'}",
    )
    told = [s for s, px in zip(sides, (right_px, down_px), strict=True) if abs(px) >= 1.0]
    return Cure(
        cause="focal",
        words=f"the principal point is {' and '.join(told) or 'elsewhere'}; was the video cropped "
        "after its poses or its camera were made?",
        undo=undo,
    )


def rescaled(factor: float, pelvis: Float[np.ndarray, "3"]) -> Cure:
    """A person who is too small (factor above 1) or too large for where the poses put them.

    Nothing but the ratio of size and distance is seen in pictures, and the body's size is its own:
    so distances shrink by the factor. With one camera, or cameras in one place, they shrink
    towards it; else the whole world does, cameras included.
    """

    def undo(claim: Claim) -> Claim:
        eyes = claim.eyes()
        fixed = eyes.mean(axis=0) if np.ptp(eyes, axis=0).max() < 1e-3 else np.zeros(3)
        pelves = pelvis + claim.motion.root_translations
        moved = fixed + (pelves - fixed) / factor
        extrinsics = claim.extrinsics.copy()
        turned = extrinsics[:, :3, :3]
        extrinsics[:, :3, 3] = -np.einsum("cab,cb->ca", turned, fixed + (eyes - fixed) / factor)
        return replace(
            claim,
            motion=replace(claim.motion, root_translations=moved - pelvis),
            extrinsics=extrinsics,
        )

    wrong = "small" if factor > 1.0 else "large"
    words = f"the body is too {wrong} for its distance; {factor:.3f} times its size fits"
    return Cure(cause="body_scale", words=words, undo=undo, factor=factor)
