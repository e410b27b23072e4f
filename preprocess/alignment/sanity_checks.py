"""What can be said of poses and masks without drawing a body: gaps, jumps, ranges, views."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from preprocess.alignment.capture_geometry import CaptureGeometry, frame_step
from preprocess.alignment.silhouette_objective import SilhouetteObjective
from preprocess.poses.plausibility import plausibility_warnings

MIN_JUMP_M, MIN_JUMP_RAD = 0.25, np.deg2rad(40.0)
"""What nobody does from one frame to the next …"""
MIN_JUMP_RATIO = 6.0
"""… unless all frames are that far apart: a jump is so many times the usual step, too."""
VIEW_SECTORS = 12
MIN_VIEW_COVERAGE = 0.5
MIN_PERSON_PX = 60
MAX_BETA = 6.0
MAX_LISTED_FRAMES = 6


def sanity_warnings(
    geometry: CaptureGeometry,
    frames: list[int],
    objective: SilhouetteObjective | None,
    height_px: int,
) -> Iterator[str]:
    """Sentences about what is odd, for people.

    Args:
        claim: Poses and cameras.
        frames: Numbers of the wanted frames.
        evidence: Masks of some frames, if there are any.
        height_px: Of the pictures.
    """
    yield from _missing_pose_warnings(geometry, frames)
    yield from _timestamp_warnings(geometry, frames)
    yield from _range_warnings(geometry)
    yield from _jump_warnings(geometry)
    seen = view_coverage(geometry)
    if seen < MIN_VIEW_COVERAGE:
        yield (
            f"The video shows the person from only {seen:.0%} of the directions around them; what "
            "it does not show cannot be learnt. Film the person turning round once."
        )
    if objective is not None:
        yield from _mask_warnings(objective)
        yield from _framing_warnings(objective, height_px)


def view_coverage(geometry: CaptureGeometry) -> float:
    """Share of the directions around the body from which a camera sees it, in twelve sectors."""
    valid = geometry.motion.valid
    roots = Rotation.from_rotvec(geometry.motion.root_rotations[valid])
    eyes = geometry.camera_centers()[geometry.camera_rows()[valid]]
    seen = roots.inv().apply(eyes - geometry.motion.root_translations[valid])
    sector = np.floor((np.arctan2(seen[:, 0], seen[:, 2]) / (2.0 * np.pi) + 0.5) * VIEW_SECTORS)
    return len(np.unique(sector.clip(0, VIEW_SECTORS - 1))) / VIEW_SECTORS


def _missing_pose_warnings(claim: CaptureGeometry, frames: list[int]) -> Iterator[str]:
    valid = claim.motion.valid
    lost = int((~valid).sum())
    if lost:
        yield (
            f"{lost} of {len(valid)} poses are NaN or marked as not valid; their frames are left "
            "out."
        )
    bare = [frame for frame in frames if claim.row_for_frame(frame) is None]
    if len(bare) > lost:
        yield f"{len(bare)} of {len(frames)} frames have no pose{_list_frames(bare)}."


def _timestamp_warnings(claim: CaptureGeometry, frames: list[int]) -> Iterator[str]:
    """Whether the poses' times are the video's."""
    times = claim.motion.times_s
    known = np.isfinite(claim.row_frames)
    if times is None or claim.motion.frames is not None or not known.any():
        return
    inside = (claim.row_frames[known] >= frames[0] - 0.5) & (
        claim.row_frames[known] <= frames[-1] + 0.5
    )
    last = int(np.argmax(np.where(known, np.abs(times), 0.0)))
    if inside.mean() >= 0.5 or claim.row_frames[last] == 0.0:
        return
    seconds = times[last] / claim.row_frames[last]
    yield (
        f"The poses' times run from {times[known].min():.6g} to {times[known].max():.6g} s, the "
        f"frames' from {seconds * frames[0]:.3g} to {seconds * frames[-1]:.3g} s; `time` is in "
        "seconds since the video's first frame. Milliseconds, or another clock?"
    )


def _range_warnings(claim: CaptureGeometry) -> Iterator[str]:
    motion = claim.motion
    yield from plausibility_warnings(motion)
    if len(motion.betas) and np.abs(motion.betas).max() > MAX_BETA:
        yield f"A shape coefficient is {np.abs(motion.betas).max():.1f}; people have -3 to 3."


def find_jumps(geometry: CaptureGeometry) -> tuple[list[int], float]:
    """Frames before which there is a step far larger than the others; share of poses that rest."""
    motion = geometry.motion
    if motion.valid.sum() < 3:
        return [], 0.0
    rows = np.flatnonzero(motion.valid)
    rows = rows[np.argsort(geometry.row_frames[rows], kind="stable")]
    near = np.diff(geometry.row_frames[rows]) <= 1.5 * frame_step(geometry.row_frames)
    moved = np.linalg.norm(np.diff(motion.root_translations[rows], axis=0), axis=1)
    roots = Rotation.from_rotvec(motion.root_rotations[rows])
    turned = (roots[:-1].inv() * roots[1:]).magnitude()
    jumped = near & (_outliers(moved, MIN_JUMP_M) | _outliers(turned, MIN_JUMP_RAD))
    still = near & (moved == 0.0) & (turned == 0.0)
    after = [int(geometry.row_frames[row]) for row in rows[1:][jumped]]
    return after, float(still.sum() / max(1, near.sum()))


def _jump_warnings(claim: CaptureGeometry) -> Iterator[str]:
    """What those steps are called."""
    after, still = find_jumps(claim)
    if after:
        times = "once" if len(after) == 1 else f"{len(after)} times"
        yield f"The poses jump {times}{_list_frames(after)}. Did the tracker change persons?"
    if still > 0.2:
        yield f"{still:.0%} of the poses are the same as the one before."


def _outliers(steps: Float[np.ndarray, "steps"], least: float) -> Bool[np.ndarray, "steps"]:
    return (steps > least) & (steps > MIN_JUMP_RATIO * np.median(steps))


def _mask_warnings(evidence: SilhouetteObjective) -> Iterator[str]:
    """Masks that cannot be used, or are no outlines."""
    looked = len(evidence.rejections) + len(evidence.samples)
    if evidence.rejections:
        first = evidence.rejections[0].rstrip(".")
        yield (
            f"{len(evidence.rejections)} of {looked} masks that were looked at cannot be used, and "
            f"their frames are left out ({first})."
        )
    if evidence.are_boxes:
        yield (
            "The masks are boxes, not outlines: all that is in them will be learnt as the person. "
            "Leave them out (--masks segmenter:grabcut), or give a segmenter's."
        )


def _framing_warnings(evidence: SilhouetteObjective, height_px: int) -> Iterator[str]:
    """Whether the whole person is in the picture, and large enough."""
    alphas = [witness.alpha > 0.5 for witness in evidence.samples]
    touching = sum(a[0].any() or a[:, 0].any() or a[:, -1].any() or a[-1].any() for a in alphas)
    if touching > 0.2 * len(alphas):
        yield (
            f"In {touching} of {len(alphas)} frames the person touches the picture's rim; what is "
            "outside cannot be learnt."
        )
    heights = [np.ptp(np.flatnonzero(a.any(axis=1))) + 1 for a in alphas]
    tall = float(np.median(heights)) / alphas[0].shape[0] * height_px
    if tall < MIN_PERSON_PX:
        yield f"The person is {tall:.0f} px high; little detail can be learnt from that."


def _list_frames(frames: list[int]) -> str:
    shown = ", ".join(str(frame) for frame in frames[:MAX_LISTED_FRAMES])
    return f" ({shown}{', …' if len(frames) > MAX_LISTED_FRAMES else ''})"
