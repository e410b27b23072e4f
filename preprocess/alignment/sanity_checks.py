"""Checks of poses and masks that need no rendering: gaps, jumps, ranges, view coverage."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from preprocess.alignment.capture_geometry import CaptureGeometry, frame_step
from preprocess.alignment.silhouette_objective import SilhouetteObjective
from preprocess.poses.plausibility import lost_pose_warnings, plausibility_warnings

MIN_JUMP_M = 0.25
"""Least step of the root between frames that is a jump, metres."""
MIN_JUMP_RAD = np.deg2rad(40.0)
"""Least turn of the root between frames that is a jump, radians."""
MIN_JUMP_RATIO = 6.0
"""Ratio to the median step that a jump must also exceed."""
VIEW_SECTORS = 12
"""Sectors of directions around the body."""
MIN_VIEW_COVERAGE = 0.5
"""Fraction of the sectors below which the video shows too few sides."""
MIN_PERSON_PX = 60
"""Median height of the person below which there is little detail, px."""
MAX_BETA = 6.0
"""Largest plausible magnitude of a shape coefficient."""
MAX_LISTED_FRAMES = 6
"""Frame numbers that a message lists."""


def sanity_warnings(
    geometry: CaptureGeometry,
    frames: list[int],
    objective: SilhouetteObjective | None,
    height_px: int,
) -> Iterator[str]:
    """Describe what is implausible, for people.

    Args:
        geometry: Poses and cameras.
        frames: Numbers of the selected frames.
        objective: Masks of some frames, if there are any.
        height_px: Height of the images.
    """
    yield from _missing_pose_warnings(geometry, frames)
    yield from _timestamp_warnings(geometry, frames)
    yield from _range_warnings(geometry)
    yield from _jump_warnings(geometry)
    seen = view_coverage(geometry)
    if seen < MIN_VIEW_COVERAGE:
        yield (
            f"The video shows the person from only {seen:.0%} of the directions around them; what "
            "it does not show cannot be learnt. Film the person turning around once."
        )
    if objective is not None:
        yield from _mask_warnings(objective)
        yield from _framing_warnings(objective, height_px)


def view_coverage(geometry: CaptureGeometry) -> float:
    """Fraction of the `VIEW_SECTORS` around the body from which a camera sees it."""
    valid = geometry.motion.valid
    roots = Rotation.from_rotvec(geometry.motion.root_rotations[valid])
    eyes = geometry.camera_centers()[geometry.camera_rows()[valid]]
    seen = roots.inv().apply(eyes - geometry.motion.root_translations[valid])
    sector = np.floor((np.arctan2(seen[:, 0], seen[:, 2]) / (2.0 * np.pi) + 0.5) * VIEW_SECTORS)
    return len(np.unique(sector.clip(0, VIEW_SECTORS - 1))) / VIEW_SECTORS


def _missing_pose_warnings(geometry: CaptureGeometry, frames: list[int]) -> Iterator[str]:
    yield from lost_pose_warnings(geometry.motion)
    bare = [frame for frame in frames if geometry.row_for_frame(frame) is None]
    if len(bare) > int((~geometry.motion.valid).sum()):
        yield f"{len(bare)} of {len(frames)} frames have no pose{_list_frames(bare)}."


def _timestamp_warnings(geometry: CaptureGeometry, frames: list[int]) -> Iterator[str]:
    """Times of poses that are not the video's."""
    times = geometry.motion.times_s
    known = np.isfinite(geometry.row_frames)
    if times is None or geometry.motion.frames is not None or not known.any():
        return
    inside = (geometry.row_frames[known] >= frames[0] - 0.5) & (
        geometry.row_frames[known] <= frames[-1] + 0.5
    )
    last = int(np.argmax(np.where(known, np.abs(times), 0.0)))
    if inside.mean() >= 0.5 or geometry.row_frames[last] == 0.0:
        return
    seconds = times[last] / geometry.row_frames[last]
    yield (
        f"The poses' times run from {times[known].min():.6g} to {times[known].max():.6g} s, the "
        f"frames' from {seconds * frames[0]:.3g} to {seconds * frames[-1]:.3g} s; `time` is in "
        "seconds since the video's first frame. Milliseconds, or another clock?"
    )


def _range_warnings(geometry: CaptureGeometry) -> Iterator[str]:
    motion = geometry.motion
    yield from plausibility_warnings(motion)
    if len(motion.betas) and np.abs(motion.betas).max() > MAX_BETA:
        yield f"A shape coefficient is {np.abs(motion.betas).max():.1f}; people have -3 to 3."


def find_jumps(geometry: CaptureGeometry) -> tuple[list[int], float]:
    """Frames before which the root jumps; the fraction of poses that repeat the one before."""
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


def _jump_warnings(geometry: CaptureGeometry) -> Iterator[str]:
    """Jumps and repeated poses."""
    after, still = find_jumps(geometry)
    if after:
        times = "once" if len(after) == 1 else f"{len(after)} times"
        yield (
            f"The poses jump {times}{_list_frames(after)}. Did the tracker switch to another "
            "person?"
        )
    if still > 0.2:
        yield f"{still:.0%} of the poses are the same as the one before."


def _outliers(steps: Float[np.ndarray, "steps"], least: float) -> Bool[np.ndarray, "steps"]:
    return (steps > least) & (steps > MIN_JUMP_RATIO * np.median(steps))


def _mask_warnings(objective: SilhouetteObjective) -> Iterator[str]:
    """Masks that cannot be used, or are boxes."""
    looked = len(objective.rejections) + len(objective.samples)
    if objective.rejections:
        first = objective.rejections[0].rstrip(".")
        yield (
            f"{len(objective.rejections)} of {looked} sampled masks cannot be used, and "
            f"their frames are left out ({first})."
        )
    if objective.are_boxes:
        yield (
            "The masks are boxes, not outlines: all that is in them will be learnt as the person. "
            "Leave them out (--masks segmenter:blazepose), or give a segmenter's."
        )


def _framing_warnings(objective: SilhouetteObjective, height_px: int) -> Iterator[str]:
    """Persons who are cut off by the image's border, or small."""
    alphas = [sample.alpha > 0.5 for sample in objective.samples]
    touching = sum(a[0].any() or a[:, 0].any() or a[:, -1].any() or a[-1].any() for a in alphas)
    if touching > 0.2 * len(alphas):
        yield (
            f"In {touching} of {len(alphas)} frames the person touches the image's border; what is "
            "outside cannot be learnt."
        )
    heights = [np.ptp(np.flatnonzero(a.any(axis=1))) + 1 for a in alphas]
    tall = float(np.median(heights)) / alphas[0].shape[0] * height_px
    if tall < MIN_PERSON_PX:
        yield f"The person is {tall:.0f} px high; little detail can be learnt from that."


def _list_frames(frames: list[int]) -> str:
    shown = ", ".join(str(frame) for frame in frames[:MAX_LISTED_FRAMES])
    return f" ({shown}{', …' if len(frames) > MAX_LISTED_FRAMES else ''})"
