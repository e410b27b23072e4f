"""Plausibility of poses: which numbers cannot be a body's pose, and which are only odd.

Every command that reads poses checks them here:

    motion = read_poses(path)                         # as the file has it, for ia-check to correct
    motion = require_plausible(motion, path)          # refuses degrees and millimetres
    for sentence in plausibility_warnings(motion): …  # possible, but hardly meant
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from capture.input_error import InputError
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import rotation_matrices

MAX_JOINT_ANGLE_RAD = 4.0 * np.pi
"""Largest angle of a joint in any pose. An axis-angle needs π; optimizers may leave 2π or 3π."""
SUSPICIOUS_JOINT_ANGLE_RAD = 1.5 * np.pi
"""Angle of a joint that is worth a warning."""
MAX_STEP_M = 10.0
"""Largest median distance between the places of consecutive frames, metres."""
MAX_DISTANCE_M = 1000.0
"""Largest median distance from the origin, metres."""
SUSPICIOUS_DISTANCE_M = 50.0
"""Median distance from the origin beyond which the unit is in doubt, metres."""
FULL_TURN_RAD = 2.0 * np.pi
"""Angle of the root beyond which it is either a spin that keeps counting, or in degrees."""
MAX_SPIN_STEP_RAD = np.pi
"""Largest median step of a spin from pose to pose; a larger one means degrees."""
MAX_SPIN_START_RAD = 8.0 * np.pi
"""Largest angle at which a spin begins; a larger one means degrees."""
FLIP_RAD = 0.5 * np.pi
"""Rotation of the root between two frames from which it may be a flip."""
MAX_TURN_RAD_PER_S = 16.0
"""Fastest rotation of a person, 2.5 turns a second."""
MAX_FLIP_FRAMES = 8
"""Most poses in a row that are flipped."""
MAX_DETOUR_RAD = 0.25
"""How far the root may stray from its usual speed between the poses around a flip."""
MAX_FLIP_SHARE = 0.1
"""Largest share of flipped poses; if there are more, these are no frames of a film."""
ASSUMED_FPS = 30.0
"""Rate that is assumed where poses have times but no frame numbers."""


def require_plausible(motion: Motion, path: Path | str) -> Motion:
    """Return the motion with impossible rows marked as not valid.

    Args:
        motion: As it was read.
        path: The file, for the message.

    Raises:
        InputError: If the numbers cannot be poses of a body in radians and metres.
    """
    reason = implausibility_reason(motion)
    if reason is not None:
        raise InputError(f"{path}: {reason}")
    return invalidate_implausible_rows(motion)


def invalidate_implausible_rows(motion: Motion) -> Motion:
    """Return the motion with rows that bend a joint too far, or flip, marked as not valid."""
    bent = exceeds_joint_limits(motion.joint_rotations)
    return replace(motion, valid=motion.valid & ~bent & ~find_flips(motion))


def exceeds_joint_limits(
    joint_rotations: Float[np.ndarray, "*poses 23 3"],
) -> Bool[np.ndarray, "*poses"]:
    """Find poses in which a joint is turned by more than `MAX_JOINT_ANGLE_RAD`."""
    return np.asarray((np.linalg.norm(joint_rotations, axis=-1) > MAX_JOINT_ANGLE_RAD).any(axis=-1))


def find_flips(motion: Motion) -> Bool[np.ndarray, "poses"]:
    """Find short runs of poses that face another way than those before and after them.

    Trackers take front for back now and then, for a few frames. A run begins or ends with a turn
    that is too fast for a person; its other end may be smooth, where the person is seen from the
    side. Where many poses are flipped, they are photographs.
    """
    flips, rows = np.zeros(len(motion), bool), np.flatnonzero(motion.valid)
    if len(rows) < 3:
        return flips
    roots, gaps_s = rotation_matrices(motion.root_rotations[rows]), np.diff(_times_s(motion)[rows])
    turned = _angles_between(roots[:-1], roots[1:])
    usual = float(np.median(turned))
    for jump in np.flatnonzero((turned > FLIP_RAD) & (turned > MAX_TURN_RAD_PER_S * gaps_s)):
        if flips[rows[jump]]:
            continue  # the end of a run
        for length in range(1, MAX_FLIP_FRAMES + 1):
            starts = np.array([jump + 1, jump + 1 - length])
            starts = starts[(starts > 0) & (starts + length < len(rows))]
            detours = _angles_between(roots[starts - 1], roots[starts + length])
            found = starts[detours < MAX_DETOUR_RAD + 1.5 * usual * (length + 1)]
            if len(found):
                flips[rows[found[0] : found[0] + length]] = True
                break
    return flips if flips.sum() <= MAX_FLIP_SHARE * len(rows) else np.zeros_like(flips)


def implausibility_reason(motion: Motion) -> str | None:
    """Say why the numbers cannot be poses in radians and metres; None if they can."""
    joints = motion.joint_rotations[motion.valid]
    bad = int(exceeds_joint_limits(joints).sum())
    if 2 * bad > len(joints):
        largest = np.rad2deg(np.linalg.norm(joints, axis=-1).max())
        return (
            f"A joint is bent by {largest:.0f}°, and one by more than "
            f"{np.rad2deg(MAX_JOINT_ANGLE_RAD):.0f}° in {bad} of {len(joints)} poses; were "
            "axis-angles in radians expected, and degrees given? Multiply the rotations by "
            "pi / 180 (numpy.deg2rad)."
        )
    if _has_assumed_focal(motion):
        return None
    step_m, distance_m = _median_step_m(motion), _median_distance_m(motion)
    if step_m > MAX_STEP_M or distance_m > MAX_DISTANCE_M:
        return (
            f"The body is {distance_m:,.0f} m from the origin and moves by {step_m:,.1f} m from "
            "frame to frame (medians); were translations in metres expected, and millimetres or "
            "centimetres given? Divide them by 1000 or 100."
        )
    return None


def lost_pose_warnings(motion: Motion) -> Iterator[str]:
    """Yield a sentence about poses that are not valid, if there are any."""
    lost = len(motion) - int(motion.valid.sum())
    if lost:
        yield (
            f"{lost} of {len(motion)} poses are NaN, implausible or marked as not valid; their "
            "frames are left out."
        )


def plausibility_warnings(motion: Motion) -> Iterator[str]:
    """Yield sentences about numbers that are possible but hardly meant; none of impossible ones."""
    if implausibility_reason(motion) is not None:
        return
    joints, roots = motion.joint_rotations[motion.valid], motion.root_rotations[motion.valid]
    bad = int(exceeds_joint_limits(joints).sum())
    if bad:
        yield (
            f"{bad} of {len(motion)} poses bend a joint by more than "
            f"{np.rad2deg(MAX_JOINT_ANGLE_RAD):.0f}°, which no pose needs; they are left out."
        )
    flips = np.flatnonzero(find_flips(motion))
    if len(flips):
        yield (
            f"{len(flips)} of {len(motion)} poses (the first is row {flips[0]}) face another way "
            "than those just before and after them: front was taken for back. They are left out."
        )
    angles = np.linalg.norm(joints[~exceeds_joint_limits(joints)], axis=-1)
    if angles.size and angles.max() > SUSPICIOUS_JOINT_ANGLE_RAD:
        yield (
            f"A joint is bent by {np.rad2deg(angles.max()):.0f}°; were axis-angles in radians "
            "expected, and degrees given?"
        )
    turned, step_rad = np.linalg.norm(roots, axis=-1), _median_root_step_rad(roots)
    if turned.max(initial=0.0) > FULL_TURN_RAD and (
        step_rad > MAX_SPIN_STEP_RAD or turned.min() > MAX_SPIN_START_RAD
    ):
        yield (
            f"The root is turned by up to {np.rad2deg(turned.max()):.0f}°, and by "
            f"{np.rad2deg(step_rad):.0f}° from pose to pose (the median); were axis-angles in "
            "radians expected, and degrees given?"
        )
    distance_m = _median_distance_m(motion)
    if distance_m > SUSPICIOUS_DISTANCE_M and not _has_assumed_focal(motion):
        yield f"The poses lie {distance_m:.0f} m from the origin; are they in metres?"


def _angles_between(
    a: Float[np.ndarray, "*batch 3 3"], b: Float[np.ndarray, "*batch 3 3"]
) -> Float[np.ndarray, "*batch"]:
    """Angles of the rotations from one to another, radians."""
    return np.arccos(np.clip(0.5 * ((a * b).sum(axis=(-2, -1)) - 1.0), -1.0, 1.0))


def _times_s(motion: Motion) -> Float[np.ndarray, "poses"]:
    """Times of the poses, or what they are at the assumed rate."""
    if motion.times_s is not None:
        return motion.times_s
    numbers = np.arange(len(motion)) if motion.frames is None else motion.frames
    return numbers / ASSUMED_FPS


def _has_assumed_focal(motion: Motion) -> bool:
    """Whether depths are for the tracker's own focal length, and grow with it without limit."""
    return motion.assumed_focal is not None or (
        motion.space == "camera" and motion.intrinsic is not None
    )


def _median_root_step_rad(roots: Float[np.ndarray, "poses 3"]) -> float:
    """Median change of the root's axis-angle from pose to pose, radians; 0 for one pose."""
    steps = np.linalg.norm(np.diff(roots, axis=0), axis=1)
    return float(np.median(steps)) if len(steps) else 0.0


def _median_distance_m(motion: Motion) -> float:
    """Median distance of the valid poses from the origin, metres; 0 if there are none."""
    places = motion.root_translations[motion.valid]
    return float(np.median(np.linalg.norm(places, axis=1))) if len(places) else 0.0


def _median_step_m(motion: Motion) -> float:
    """Median distance per frame between the places of valid poses, metres; 0 for one pose."""
    rows = np.flatnonzero(motion.valid)
    if len(rows) < 2:
        return 0.0
    numbers = np.arange(len(motion), dtype=np.float64)
    if motion.frames is not None:
        numbers = motion.frames.astype(np.float64)
    elif motion.times_s is not None:
        numbers = motion.times_s * ASSUMED_FPS
    frames = np.maximum(np.abs(np.diff(numbers[rows])), 1.0)
    moved = np.linalg.norm(np.diff(motion.root_translations[rows], axis=0), axis=1)
    return float(np.median(moved / frames))
