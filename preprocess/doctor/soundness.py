"""What can be said of poses and masks without drawing a body: gaps, jumps, ranges, views."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from preprocess.doctor.claim import Claim, step_of
from preprocess.doctor.evidence import Evidence
from preprocess.plausibility import oddities

JUMP_M, JUMP_RAD = 0.25, np.deg2rad(40.0)
"""What nobody does from one frame to the next …"""
JUMPS = 6.0
"""… unless all frames are that far apart: a jump is so many times the usual step, too."""
SECTORS = 12
ENOUGH_SECTORS = 0.5
SMALL_PX = 60
LARGE_BETA = 6.0
NAMED = 6


def unsound(
    claim: Claim, frames: list[int], evidence: Evidence | None, height_px: int
) -> Iterator[str]:
    """Sentences about what is odd, for people.

    Args:
        claim: Poses and cameras.
        frames: Numbers of the wanted frames.
        evidence: Masks of some frames, if there are any.
        height_px: Of the pictures.
    """
    yield from _gaps(claim, frames)
    yield from _times(claim, frames)
    yield from _ranges(claim)
    yield from _jumps(claim)
    seen = views(claim)
    if seen < ENOUGH_SECTORS:
        yield (
            f"The video shows the person from only {seen:.0%} of the directions around them; what "
            "it does not show cannot be learnt. Film the person turning round once."
        )
    if evidence is not None:
        yield from _unusable(evidence)
        yield from _framing(evidence, height_px)


def views(claim: Claim) -> float:
    """Share of the directions around the body from which a camera sees it, in twelve sectors."""
    valid = claim.motion.valid
    roots = Rotation.from_rotvec(claim.motion.root_rotations[valid])
    eyes = claim.eyes()[claim.camera_rows()[valid]]
    seen = roots.inv().apply(eyes - claim.motion.root_translations[valid])
    sector = np.floor((np.arctan2(seen[:, 0], seen[:, 2]) / (2.0 * np.pi) + 0.5) * SECTORS)
    return len(np.unique(sector.clip(0, SECTORS - 1))) / SECTORS


def _gaps(claim: Claim, frames: list[int]) -> Iterator[str]:
    valid = claim.motion.valid
    lost = int((~valid).sum())
    if lost:
        yield (
            f"{lost} of {len(valid)} poses are NaN or marked as not valid; their frames are left "
            "out."
        )
    bare = [frame for frame in frames if claim.row_of(frame) is None]
    if len(bare) > lost:
        yield f"{len(bare)} of {len(frames)} frames have no pose{_named(bare)}."


def _times(claim: Claim, frames: list[int]) -> Iterator[str]:
    """Whether the poses' times are the video's."""
    times = claim.motion.times_s
    known = np.isfinite(claim.places)
    if times is None or claim.motion.frames is not None or not known.any():
        return
    inside = (claim.places[known] >= frames[0] - 0.5) & (claim.places[known] <= frames[-1] + 0.5)
    last = int(np.argmax(np.where(known, np.abs(times), 0.0)))
    if inside.mean() >= 0.5 or claim.places[last] == 0.0:
        return
    seconds = times[last] / claim.places[last]
    yield (
        f"The poses' times run from {times[known].min():.6g} to {times[known].max():.6g} s, the "
        f"frames' from {seconds * frames[0]:.3g} to {seconds * frames[-1]:.3g} s; `time` is in "
        "seconds since the video's first frame. Milliseconds, or another clock?"
    )


def _ranges(claim: Claim) -> Iterator[str]:
    motion = claim.motion
    yield from oddities(motion)
    if len(motion.betas) and np.abs(motion.betas).max() > LARGE_BETA:
        yield f"A shape coefficient is {np.abs(motion.betas).max():.1f}; people have -3 to 3."


def jumps(claim: Claim) -> tuple[list[int], float]:
    """Frames before which there is a step far larger than the others; share of poses that rest."""
    motion = claim.motion
    if motion.valid.sum() < 3:
        return [], 0.0
    rows = np.flatnonzero(motion.valid)
    rows = rows[np.argsort(claim.places[rows], kind="stable")]
    near = np.diff(claim.places[rows]) <= 1.5 * step_of(claim.places)
    moved = np.linalg.norm(np.diff(motion.root_translations[rows], axis=0), axis=1)
    roots = Rotation.from_rotvec(motion.root_rotations[rows])
    turned = (roots[:-1].inv() * roots[1:]).magnitude()
    jumped = near & (_outliers(moved, JUMP_M) | _outliers(turned, JUMP_RAD))
    still = near & (moved == 0.0) & (turned == 0.0)
    after = [int(claim.places[row]) for row in rows[1:][jumped]]
    return after, float(still.sum() / max(1, near.sum()))


def _jumps(claim: Claim) -> Iterator[str]:
    """What those steps are called."""
    after, still = jumps(claim)
    if after:
        times = "once" if len(after) == 1 else f"{len(after)} times"
        yield f"The poses jump {times}{_named(after)}. Did the tracker change persons?"
    if still > 0.2:
        yield f"{still:.0%} of the poses are the same as the one before."


def _outliers(steps: Float[np.ndarray, "steps"], least: float) -> Bool[np.ndarray, "steps"]:
    return (steps > least) & (steps > JUMPS * np.median(steps))


def _unusable(evidence: Evidence) -> Iterator[str]:
    """Masks that cannot be used, or are no outlines."""
    looked = len(evidence.refused) + len(evidence.witnesses)
    if evidence.refused:
        first = evidence.refused[0].rstrip(".")
        yield (
            f"{len(evidence.refused)} of {looked} masks that were looked at cannot be used, and "
            f"their frames are left out ({first})."
        )
    if evidence.boxes:
        yield (
            "The masks are boxes, not outlines: all that is in them will be learnt as the person. "
            "Leave them out (--masks segmenter:grabcut), or give a segmenter's."
        )


def _framing(evidence: Evidence, height_px: int) -> Iterator[str]:
    """Whether the whole person is in the picture, and large enough."""
    alphas = [witness.alpha > 0.5 for witness in evidence.witnesses]
    touching = sum(a[0].any() or a[:, 0].any() or a[:, -1].any() or a[-1].any() for a in alphas)
    if touching > 0.2 * len(alphas):
        yield (
            f"In {touching} of {len(alphas)} frames the person touches the picture's rim; what is "
            "outside cannot be learnt."
        )
    heights = [np.ptp(np.flatnonzero(a.any(axis=1))) + 1 for a in alphas]
    tall = float(np.median(heights)) / alphas[0].shape[0] * height_px
    if tall < SMALL_PX:
        yield f"The person is {tall:.0f} px high; little detail can be learnt from that."


def _named(frames: list[int]) -> str:
    shown = ", ".join(str(frame) for frame in frames[:NAMED])
    return f" ({shown}{', …' if len(frames) > NAMED else ''})"
