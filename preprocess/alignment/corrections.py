"""A mistake in a capture as the change that undoes it, and those mistakes that have a size."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from preprocess.alignment.capture_geometry import CaptureGeometry

CAUSES = (
    "mask_polarity", "second_person", "world_frame", "opengl_axes", "root_rotation", "frame_offset",
    "frame_rate", "left_right", "root_origin", "focal", "body_scale", "video_rotation",
    "video_mirrored", "video_offset", "video_crop",
)  # fmt: skip
"""By these names mistakes are called, in commands and files."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Correction:
    """One mistake, undone.

    Attributes:
        cause: The mistake, one of `CAUSES`.
        words: What was wrong, for people: ends the sentence "It looks as if …".
        undo: From the claim to what it should have been.
        factor: Of a fitted cure, the number that was fitted.
        frames: Of an offset, the number of frames.
    """

    cause: str
    description: str
    apply: Callable[[CaptureGeometry], CaptureGeometry]
    factor: float | None = None
    frame_shift: int | None = None


def undo_pose_delay(frames: int) -> Correction:
    """Poses that come too late (positive) or too early by some frames."""
    late, other = ("late", "early") if frames > 0 else ("early", "late")
    return Correction(
        cause="frame_offset",
        description=f"the poses come {abs(frames)} frame{'s' if abs(frames) > 1 else ''} too {late} "
        f"(or the masks too {other})",
        apply=lambda c: replace(c, row_frames=c.row_frames - frames),
        frame_shift=frames,
    )


def undo_video_rotation(quarter_turns: int) -> Correction:
    """Pictures rotated counter-clockwise by this many quarter turns, unlike masks and poses."""
    degrees = 90 * (quarter_turns % 4)
    way = "" if degrees == 180 else " counter-clockwise" if degrees == 90 else " clockwise"

    def undo(claim: CaptureGeometry) -> CaptureGeometry:
        turns = (claim.video_transform.quarter_turns - quarter_turns) % 4
        return replace(claim, video_transform=replace(claim.video_transform, quarter_turns=turns))

    return Correction(
        cause="video_rotation",
        description=f"the film alone is rotated by {min(degrees, 360 - degrees)}°{way}; its masks and "
        "poses belong to pictures that are not",
        apply=undo,
    )


def undo_video_mirroring(quarter_turns: int) -> Correction:
    """Pictures with left and right exchanged, and rotated, unlike masks and poses."""

    def undo(claim: CaptureGeometry) -> CaptureGeometry:
        film = claim.video_transform
        turns = (film.quarter_turns - quarter_turns) % 4
        return replace(
            claim, video_transform=replace(film, quarter_turns=turns, mirrored=not film.mirrored)
        )

    also = f" and rotated by {90 * quarter_turns}°" if quarter_turns else ""
    return Correction(
        cause="video_mirrored",
        description=f"the film alone is mirrored{also}; its masks and poses belong to pictures that "
        "are not",
        apply=undo,
    )


def undo_video_offset(frames: int) -> Correction:
    """A film whose frame 0 has the masks and poses of another frame number."""
    count = f"{abs(frames)} frame{'s' if abs(frames) > 1 else ''}"
    words = (
        f"the film starts {count} later than its masks and poses; was its beginning cut off?"
        if frames > 0
        else f"the film starts {count} earlier than its masks and poses"
    )
    return Correction(
        cause="video_offset",
        description=words,
        apply=lambda c: replace(
            c,
            video_transform=replace(
                c.video_transform, first_frame=c.video_transform.first_frame + frames
            ),
        ),
        frame_shift=frames,
    )


def undo_video_reversal(frames: int) -> Correction:
    """A film of some frames that runs backwards against masks and poses."""
    return Correction(
        cause="video_offset",
        description="the film runs backwards against its masks and poses",
        apply=lambda c: replace(
            c, video_transform=replace(c.video_transform, first_frame=frames - 1, backwards=True)
        ),
    )


def undo_video_crop(window: tuple[float, float, float, float]) -> Correction:
    """A film that shows only a part of the masks' picture, or has borders added around it.

    Args:
        window: Left, top, right and bottom of the film's picture in the mask's, as fractions.
    """
    left, top, right, bottom = window
    inside = right - left < 1.0 and bottom - top < 1.0
    kind = "was cropped" if inside else "has borders, or was scaled down"
    return Correction(
        cause="video_crop",
        description=f"the film {kind} after its masks and poses were made: it shows {left:.0%} to "
        f"{right:.0%} of their width and {top:.0%} to {bottom:.0%} of their height",
        apply=lambda c: replace(c, video_transform=replace(c.video_transform, window=window)),
        factor=right - left,
    )


def scale_focal_length(factor: float) -> Correction:
    """Focal lengths that are too short (factor above 1) or too long."""

    def undo(claim: CaptureGeometry) -> CaptureGeometry:
        intrinsics = claim.intrinsics.copy()
        intrinsics[:, [0, 1], [0, 1]] *= factor
        return replace(claim, intrinsics=intrinsics)

    wrong = "short" if factor > 1.0 else "long"
    return Correction(
        cause="focal",
        description=f"the focal length is too {wrong}; {factor:.3f} times fits",
        apply=undo,
        factor=factor,
    )


def shift_principal_point(right_px: float, down_px: float) -> Correction:
    """Principal points that are so many pixels too far left and up (negative: right and down)."""

    def undo(claim: CaptureGeometry) -> CaptureGeometry:
        intrinsics = claim.intrinsics.copy()
        intrinsics[:, :2, 2] += np.array([right_px, down_px])
        return replace(claim, intrinsics=intrinsics)

    sides = (
        f"{abs(right_px):.0f} px too far {'left' if right_px > 0.0 else 'right'}",
        f"{abs(down_px):.0f} px too far {'up' if down_px > 0.0 else 'down'}",
    )
    shown = [s for s, px in zip(sides, (right_px, down_px), strict=True) if abs(px) >= 1.0]
    return Correction(
        cause="focal",
        description=f"the principal point is {' and '.join(shown) or 'elsewhere'}; was the video cropped "
        "after its poses or its camera were made?",
        apply=undo,
    )


def divide_distances(factor: float, pelvis: Float[np.ndarray, "3"]) -> Correction:
    """A person who is too small (factor above 1) or too large for where the poses put them.

    Nothing but the ratio of size and distance is seen in pictures, and the body's size is its own:
    so distances shrink by the factor. With one camera, or cameras in one place, they shrink
    towards it; else the whole world does, cameras included.
    """

    def undo(claim: CaptureGeometry) -> CaptureGeometry:
        eyes = claim.camera_centers()
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
    return Correction(cause="body_scale", description=words, apply=undo, factor=factor)
