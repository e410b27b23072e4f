"""Plausibility of poses: which numbers cannot be a body's pose, and which are only odd.

Every command that reads poses judges them here, so that all of them know the same mistakes:

    motion = read_poses(path)            # as the file has it; ia-check needs it so, to mend it
    motion = plausible(motion, path)     # refuses degrees and millimetres, drops single bad rows
    for sentence in oddities(motion): …  # what may be meant, as a warning
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from capture.errors import BadInput
from preprocess.pose import Motion

LARGEST_BEND_RAD = 4.0 * np.pi
"""Largest angle of a joint in any pose. An axis-angle needs π; optimizers may leave 2π or 3π."""
ODD_BEND_RAD = 1.5 * np.pi
"""Angle of a joint that is worth a warning."""
LARGEST_STEP_M = 10.0
"""Largest median distance between the places of consecutive frames, metres."""
LARGEST_DISTANCE_M = 1000.0
"""Largest median distance from the origin, metres."""
FAR_M = 50.0
"""Median distance from the origin beyond which the unit is in doubt, metres."""
WHOLE_TURN_RAD = 2.0 * np.pi
"""Root angles beyond this are those of a spin that goes on counting, or degrees. A spin …"""
LARGEST_SPIN_RAD = np.pi
"""… counts on by less than this from pose to pose (the median), …"""
LATEST_START_RAD = 8.0 * np.pi
"""… and begins below this."""
FRAMES_A_SECOND = 30.0
"""Rate that is assumed where poses have times but no frame numbers."""


def plausible(motion: Motion, path: Path | str) -> Motion:
    """Return the motion with impossible rows marked as not valid.

    Args:
        motion: As it was read.
        path: The file, for the message.

    Raises:
        BadInput: If the numbers cannot be poses of a body in radians and metres.
    """
    reason = impossible(motion)
    if reason is not None:
        raise BadInput(f"{path}: {reason}")
    return without_impossible(motion)


def without_impossible(motion: Motion) -> Motion:
    """Return the motion with every row whose joints are bent too far marked as not valid."""
    return replace(motion, valid=motion.valid & ~overbent(motion.joint_rotations))


def overbent(joint_rotations: Float[np.ndarray, "*poses 23 3"]) -> Bool[np.ndarray, "*poses"]:
    """Find poses in which a joint is turned by more than `LARGEST_BEND_RAD`."""
    return np.asarray((np.linalg.norm(joint_rotations, axis=-1) > LARGEST_BEND_RAD).any(axis=-1))


def impossible(motion: Motion) -> str | None:
    """Say why the numbers cannot be poses in radians and metres; None if they can."""
    joints = motion.joint_rotations[motion.valid]
    bad = int(overbent(joints).sum())
    if 2 * bad > len(joints):
        largest = np.rad2deg(np.linalg.norm(joints, axis=-1).max())
        return (
            f"A joint is bent by {largest:.0f}°, and one by more than "
            f"{np.rad2deg(LARGEST_BEND_RAD):.0f}° in {bad} of {len(joints)} poses; were "
            "axis-angles in radians expected, and degrees given? Multiply the rotations by "
            "pi / 180 (numpy.deg2rad)."
        )
    if _is_of_another_lens(motion):
        return None
    step_m, distance_m = _usual_step_m(motion), _usual_distance_m(motion)
    if step_m > LARGEST_STEP_M or distance_m > LARGEST_DISTANCE_M:
        return (
            f"The body is {distance_m:,.0f} m from the origin and moves by {step_m:,.1f} m from "
            "frame to frame (medians); were translations in metres expected, and millimetres or "
            "centimetres given? Divide them by 1000 or 100."
        )
    return None


def oddities(motion: Motion) -> Iterator[str]:
    """Yield sentences about numbers that are possible but hardly meant; none of impossible ones."""
    if impossible(motion) is not None:
        return
    joints, roots = motion.joint_rotations[motion.valid], motion.root_rotations[motion.valid]
    bad = int(overbent(joints).sum())
    if bad:
        yield (
            f"{bad} of {len(motion)} poses bend a joint by more than "
            f"{np.rad2deg(LARGEST_BEND_RAD):.0f}°, which no pose needs; they are left out."
        )
    angles = np.linalg.norm(joints[~overbent(joints)], axis=-1)
    if angles.size and angles.max() > ODD_BEND_RAD:
        yield (
            f"A joint is bent by {np.rad2deg(angles.max()):.0f}°; were axis-angles in radians "
            "expected, and degrees given?"
        )
    turned, step_rad = np.linalg.norm(roots, axis=-1), _usual_root_step_rad(roots)
    if turned.max(initial=0.0) > WHOLE_TURN_RAD and (
        step_rad > LARGEST_SPIN_RAD or turned.min() > LATEST_START_RAD
    ):
        yield (
            f"The root is turned by up to {np.rad2deg(turned.max()):.0f}°, and by "
            f"{np.rad2deg(step_rad):.0f}° from pose to pose (the median); were axis-angles in "
            "radians expected, and degrees given?"
        )
    distance_m = _usual_distance_m(motion)
    if distance_m > FAR_M and not _is_of_another_lens(motion):
        yield f"The poses lie {distance_m:.0f} m from the origin; are they in metres?"


def _is_of_another_lens(motion: Motion) -> bool:
    """Whether depths are for the tracker's own focal length, with which they grow without limit."""
    return motion.lens is not None or (motion.space == "camera" and motion.intrinsic is not None)


def _usual_root_step_rad(roots: Float[np.ndarray, "poses 3"]) -> float:
    """Median change of the root's axis-angle from pose to pose, radians; 0 for one pose."""
    steps = np.linalg.norm(np.diff(roots, axis=0), axis=1)
    return float(np.median(steps)) if len(steps) else 0.0


def _usual_distance_m(motion: Motion) -> float:
    """Median distance of the valid poses from the origin, metres; 0 if there are none."""
    places = motion.root_translations[motion.valid]
    return float(np.median(np.linalg.norm(places, axis=1))) if len(places) else 0.0


def _usual_step_m(motion: Motion) -> float:
    """Median distance per frame between the places of valid poses, metres; 0 for one pose."""
    rows = np.flatnonzero(motion.valid)
    if len(rows) < 2:
        return 0.0
    numbers = np.arange(len(motion), dtype=np.float64)
    if motion.frames is not None:
        numbers = motion.frames.astype(np.float64)
    elif motion.times_s is not None:
        numbers = motion.times_s * FRAMES_A_SECOND
    frames = np.maximum(np.abs(np.diff(numbers[rows])), 1.0)
    moved = np.linalg.norm(np.diff(motion.root_translations[rows], axis=0), axis=1)
    return float(np.median(moved / frames))
