"""Plausibility of poses: numbers that cannot be a body's pose, and numbers that are only odd.

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

from capture.input_error import InputError, counted
from capture.source import ASSUMED_FPS
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import JOINT_NAMES, axis_angles_from_matrices, rotation_matrices

MAX_JOINT_ANGLE_RAD = 4.0 * np.pi
"""Largest angle of a joint in any pose. An axis-angle needs π; optimizers may leave 2π or 3π."""


def require_plausible(motion: Motion, path: Path | str) -> Motion:
    """Return the motion with impossible rows marked as not valid."""
    reason = implausibility_reason(motion)
    if reason is not None:
        raise InputError(f"{path}: {reason}")
    return invalidate_implausible_rows(motion)


def invalidate_implausible_rows(motion: Motion) -> Motion:
    """Return the motion with rows that bend a joint too far, or flip, marked as not valid.

    Joints that flip by themselves, as wrists do, turn with the poses before and after them.
    """
    bent = exceeds_joint_limits(motion.joint_rotations)
    kept = replace(motion, valid=motion.valid & ~bent & ~find_flips(motion))
    return replace(kept, joint_rotations=_without_joint_flips(kept))


def exceeds_joint_limits(
    joint_rotations: Float[np.ndarray, "*poses 23 3"],
) -> Bool[np.ndarray, "*poses"]:
    """Find poses in which a joint is turned by more than `MAX_JOINT_ANGLE_RAD`."""
    return np.asarray((np.linalg.norm(joint_rotations, axis=-1) > MAX_JOINT_ANGLE_RAD).any(axis=-1))


def find_flips(motion: Motion) -> Bool[np.ndarray, "poses"]:
    """Find short runs of poses that face another way than those before and after them.

    Trackers take front for back now and then, for a few frames. Where many poses are flipped, they
    are photographs.
    """
    flips, rows = np.zeros(len(motion), bool), np.flatnonzero(motion.valid)
    roots = rotation_matrices(motion.root_rotations[rows])
    for start, end in _flipped_runs(roots, _times_s(motion)[rows], max_rad_per_s=16.0):
        flips[rows[start:end]] = True
    return flips


def _without_joint_flips(motion: Motion) -> Float[np.ndarray, "poses 23 3"]:
    """Joint rotations, those of flipped runs interpolated between the poses around them.

    Poses that were tracked here are fitted to the whole film, fast steps included, and stay.
    """
    if motion.is_fitted:
        return motion.joint_rotations
    joints, rows = motion.joint_rotations.copy(), np.flatnonzero(motion.valid)
    times_s = _times_s(motion)[rows]
    for joint in range(joints.shape[1]):
        rotations = rotation_matrices(joints[rows, joint])
        for start, end in _flipped_runs(rotations, times_s, max_rad_per_s=25.0):
            before, after = rotations[start - 1], rotations[end]
            way = axis_angles_from_matrices(before.T @ after)
            passed = times_s[start:end] - times_s[start - 1]
            steps = passed[:, None] / (times_s[end] - times_s[start - 1]) * way
            turned = before @ rotation_matrices(steps)
            joints[rows[start:end], joint] = axis_angles_from_matrices(turned)
    return joints


def _flipped_runs(
    rotations: Float[np.ndarray, "poses 3 3"],
    times_s: Float[np.ndarray, "poses"],
    max_rad_per_s: float,
) -> list[tuple[int, int]]:
    """First pose and end of each short run of rotations unlike those before and after it.

    A run begins or ends with a turn that is too fast for a person; its other end may be smooth,
    where the person is seen from the side. None where these are too many for a video, or where all
    poses are far apart.
    """
    runs: list[tuple[int, int]] = []
    count, gaps_s = len(rotations), np.diff(times_s)
    if count < 3:
        return runs
    turned = _angles_between(rotations[:-1], rotations[1:])
    usual = float(np.median(turned))
    fast = np.maximum(0.5 + 6.0 * usual, max_rad_per_s * gaps_s)  # from here on it may be a flip
    for jump in np.flatnonzero(turned > fast):
        if runs and jump < runs[-1][1]:
            continue  # the end of a run
        for length in range(1, 9):
            starts = np.array([jump + 1, jump + 1 - length])
            starts = starts[(starts > 0) & (starts + length < count)]
            detours = _angles_between(rotations[starts - 1], rotations[starts + length])
            likely = starts[detours < 0.25 + 1.5 * usual * (length + 1)]
            if len(likely):
                runs.append((int(likely[0]), int(likely[0]) + length))
                break
    # if there are more, these are no frames of a video
    return runs if sum(end - start for start, end in runs) <= 0.1 * count else []


def implausibility_reason(motion: Motion) -> str | None:
    """Say why the numbers cannot be poses in radians and metres; None if they can."""
    joints = motion.joint_rotations[motion.valid]
    bent, count = int(exceeds_joint_limits(joints).sum()), len(joints)
    if 2 * bent > count:
        largest = np.rad2deg(np.linalg.norm(joints, axis=-1).max())
        return (
            f"A joint is bent by {largest:.0f}°, and one by more than "
            f"{np.rad2deg(MAX_JOINT_ANGLE_RAD):.0f}° in {bent} of {count} poses; were "
            "axis-angles in radians expected, and degrees given? Multiply the rotations by "
            "pi / 180 (numpy.deg2rad)."
        )
    distance_m = _median_distance_m(motion)
    if distance_m > 500.0:  # metres
        return (
            f"The body is {distance_m:,.0f} m from the origin (median); were translations in "
            "metres expected, and millimetres or centimetres given? Divide them by 1000 or 100."
        )
    return None


def lost_pose_warnings(motion: Motion) -> Iterator[str]:
    """Yield a sentence about poses that are not valid, if there are any."""
    lost = len(motion) - int(motion.valid.sum())
    if lost:
        yield (
            f"Left out: {lost} of {counted(len(motion), 'pose')}, not numbers or marked as not "
            "valid."
        )


def plausibility_warnings(motion: Motion) -> Iterator[str]:
    """Yield sentences about numbers that are possible but hardly meant; none of impossible ones."""
    if implausibility_reason(motion) is not None:
        return
    bent = int(exceeds_joint_limits(motion.joint_rotations[motion.valid]).sum())
    if bent:
        yield (
            f"Left out: {bent} of {counted(len(motion), 'pose')}, with a joint bent by more than "
            f"{np.rad2deg(MAX_JOINT_ANGLE_RAD):.0f}°, which no pose needs."
        )
    flips = np.flatnonzero(find_flips(motion))
    if len(flips):
        yield (
            f"Left out: {len(flips)} of {counted(len(motion), 'pose')} (the first is row "
            f"{flips[0]}), facing another way than those just before and after: front was taken "
            "for back."
        )
    kept = invalidate_implausible_rows(motion)
    moved = (kept.joint_rotations != motion.joint_rotations).any(axis=-1) & kept.valid[:, None]
    if moved.any():
        row, joint = np.argwhere(moved)[0]
        yield (
            f"Interpolated: a joint in {int(moved.any(axis=1).sum())} of "
            f"{counted(len(motion), 'pose')} (the first is row {row}) that turns another way than "
            f"just before and after (there the {JOINT_NAMES[joint + 1].replace('_', ' ')})."
        )
    distance_m = _median_distance_m(motion)
    if distance_m > 50.0:
        yield f"The poses lie {distance_m:.0f} m from the origin; are they in metres?"


def _angles_between(
    a: Float[np.ndarray, "*batch 3 3"], b: Float[np.ndarray, "*batch 3 3"]
) -> Float[np.ndarray, "*batch"]:
    """Angles of the rotations from one to another, radians."""
    return np.arccos(np.clip(0.5 * ((a * b).sum(axis=(-2, -1)) - 1.0), -1.0, 1.0))


def _times_s(motion: Motion) -> Float[np.ndarray, "poses"]:
    """Times of the poses, by the assumed rate where there are none."""
    if motion.times_s is not None:
        return motion.times_s
    numbers = np.arange(len(motion)) if motion.frames is None else motion.frames
    return numbers / ASSUMED_FPS


def _median_distance_m(motion: Motion) -> float:
    """Median distance of the valid poses from the origin, metres.

    0 where depths are for the tracker's own focal length, and grow with it without limit.
    """
    places = motion.root_translations[motion.valid]
    has_own_focal = motion.assumed_focal is not None or (
        motion.space == "camera" and motion.intrinsic is not None
    )
    if has_own_focal or not len(places):
        return 0.0
    return float(np.median(np.linalg.norm(places, axis=1)))
