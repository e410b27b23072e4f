"""One person's motion: put together from a tracker's file, gaps filled, its root placed.

A tracker's poses are about its own body (where the pelvis rests), its own focal length, its own
camera's or world's axes. Brought to the body and the cameras that are really used, rotations stay;
only the root's place changes.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from capture.camera import Camera, Matrix3, Vector3
from preprocess.body.body_pose import Motion, PoseSpace, RelativeFocalLength, RootAnchor
from preprocess.body.kinematics import (
    JointPlaces,
    axis_angles_from_matrices,
    rotation_matrices,
    stack_axis_angles,
)
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack, tracker_intrinsic_matrix
from preprocess.cameras.camera_formats import invert_rigid

MotionByPerson = dict[str, Motion]
"""By the name that the file gives each, in the file's order."""


def build_motion(
    rotations: list[Any],
    translations: Any,
    *,
    betas: Any = None,
    frames: Any = None,
    times_s: Float[np.ndarray, "poses"] | None = None,
    lost: Any = None,
    body_model: str = "smpl",
    space: PoseSpace = "camera",
    anchor: RootAnchor = "pelvis",
    lens: Any = None,
) -> Motion:
    """Poses of one person, rows in the order of their frames.

    Args:
        rotations: Parts of the rotations, root first; see `stack_axis_angles`.
        translations: Places of the root, one row a pose, metres.
        betas: One row, or one row a pose: then their median.
        frames: The frames' numbers; of a number that comes twice the first row counts.
        lost: Rows that the tracker itself calls lost.
        lens: The camera matrix K, or one per pose; or the focal length that the tracker assumed.
    """
    is_assumed = isinstance(lens, RelativeFocalLength)
    counts = {len(part) for part in (*rotations, translations)}
    placed = np.asarray(translations, dtype=np.float64)
    if len(counts) > 1 or placed.size != 3 * len(placed):
        raise ValueError(
            f"rotations and translations of {sorted(counts)} rows, translations of the shape "
            f"{placed.shape}; expected as many rows, and 3 metres in each translation"
        )
    turned, placed = stack_axis_angles(rotations), placed.reshape(-1, 3)
    order = np.arange(len(turned))
    if frames is not None:
        frames, order = np.unique(_numbers(frames, len(turned)), return_index=True)
    if not len(turned):
        raise ValueError("no poses")
    turned, placed = turned[order], placed[order]
    numbers = np.column_stack([turned.reshape(len(turned), -1), placed])
    valid = np.asarray((np.abs(numbers) < 1e9).all(axis=1))  # none of NaN; more is damage
    if lost is not None:
        valid &= ~np.asarray(lost, dtype=bool)[order]
    return Motion(
        root_rotations=turned[:, 0],
        root_translations=placed,
        joint_rotations=turned[:, 1:],
        valid=valid,
        betas=_median_betas(betas),
        body_model=body_model,
        frames=frames,
        times_s=None if times_s is None else times_s[order],
        intrinsic=None if is_assumed else _median_intrinsic(lens),
        assumed_focal=lens if is_assumed else None,
        anchor=anchor,
        space=space,
    )


def stack_rows(rows: list[Any]) -> Float[np.ndarray, "poses *rest"]:
    """One array of a list of arrays of one shape."""
    return np.stack([np.asarray(row, dtype=np.float64) for row in rows])


def _numbers(frames: Any, count: int) -> Int[np.ndarray, "poses"]:
    numbers = np.asarray(frames, dtype=np.float64).reshape(-1)
    if len(numbers) != count or not (numbers == np.round(numbers)).all():
        raise ValueError(f"{len(numbers)} frame numbers, not all whole, for {count} poses")
    return numbers.astype(np.int64)


def _median_betas(betas: Any) -> Float[np.ndarray, "betas"]:
    if betas is None:
        return np.zeros(0)
    rows = np.asarray(betas, dtype=np.float64)
    rows = rows.reshape(-1, rows.shape[-1]) if rows.ndim else rows.reshape(1, 1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        raise ValueError("betas that are NaN; a shape of finite numbers was expected")
    return np.median(rows, axis=0)


def _median_intrinsic(intrinsic: Any) -> Matrix3 | None:
    if intrinsic is None:
        return None
    matrix = np.asarray(intrinsic, dtype=np.float64)
    matrix = np.nanmedian(matrix.reshape(-1, 3, 3), axis=0)
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0.0:
        raise ValueError("a K that is no camera matrix")
    return matrix


MAX_GAP_FRAMES = 12
"""Longest gap that is filled, frames: half a second at 24 Hz."""


def fill_gaps(motion: Motion) -> Motion:
    """The motion with short gaps filled in: slerp for rotations, straight lines for places.

    A gap is a run of at most `MAX_GAP_FRAMES` frames without a valid row between two frames with
    one. Motions without frame numbers are taken as one row a frame. Those with cameras of their own
    are bridged only where each frame has its row, and so its camera.
    """
    if motion.camera_from_world is not None and motion.frames is not None:
        return motion  # the cameras of the missing frames are unknown
    numbers = motion.frames if motion.frames is not None else np.arange(len(motion))
    good = np.flatnonzero(motion.valid)
    gaps = zip(numbers[good[:-1]] + 1, numbers[good[1:]], strict=True)
    bridged = [np.arange(*gap) for gap in gaps if 0 < gap[1] - gap[0] <= MAX_GAP_FRAMES]
    if not bridged:
        return motion
    new = np.concatenate(bridged)
    between = interpolate_rows(motion, good, numbers[good], new)
    kept = ~np.isin(numbers, new)
    order = np.argsort(np.concatenate([numbers[kept], new]), kind="stable")

    def merged(old: np.ndarray, added: np.ndarray) -> np.ndarray:
        return np.concatenate([old[kept], added])[order]

    times_s = motion.times_s
    if times_s is not None:
        times_s = np.interp(merged(numbers, new), numbers[good], times_s[good])
    return replace(
        motion,
        root_rotations=merged(motion.root_rotations, between.root_rotations),
        root_translations=merged(motion.root_translations, between.root_translations),
        joint_rotations=merged(motion.joint_rotations, between.joint_rotations),
        valid=merged(motion.valid, between.valid),
        frames=merged(numbers, new) if motion.frames is not None else None,
        times_s=times_s,
    )


def interpolate_rows(
    motion: Motion,
    rows: Int[np.ndarray, "rows"],
    places: Shaped[np.ndarray, "rows"],
    numbers: Shaped[np.ndarray, "frames"],
) -> Motion:
    """Poses at `numbers` between some rows at ascending `places`, without times and cameras."""
    from scipy.spatial.transform import Rotation, Slerp  # the player runs without scipy

    vectors = np.concatenate([motion.root_rotations[:, None], motion.joint_rotations], axis=1)[rows]
    turned = np.stack(
        [Slerp(places, Rotation.from_rotvec(each))(numbers).as_rotvec()
         for each in np.moveaxis(vectors, 1, 0)], axis=1,
    )  # fmt: skip
    moved = [np.interp(numbers, places, each) for each in motion.root_translations[rows].T]
    return replace(
        motion,
        root_rotations=turned[:, 0],
        root_translations=np.column_stack(moved),
        joint_rotations=turned[:, 1:],
        valid=np.ones(len(numbers), dtype=bool),
        frames=numbers,
        times_s=None,
        camera_from_world=None,
    )


SMPLX_PELVIS = np.array([0.0031, -0.3514, 0.0120])
"""Pelvis of SMPL-X's neutral mean shape at rest, metres (its joint regressor's)."""


def place_in_camera_world(
    motion: Motion, shaped: ShapedBody, cameras: CameraTrack, *, cameras_given: bool
) -> Motion:
    """The motion as SMPL's: about the body's pelvis, in the world of the cameras.

    Cameras are of the frames' size. Unless the user gave them, a file's own cameras count.
    """
    motion = anchor_at_pelvis(motion, shaped.joints)
    if motion.space == "camera":
        motion = _refocus_motion(motion, shaped, cameras[0])
        if cameras.is_moving or not np.allclose(cameras[0].camera_from_world, np.eye(4)):
            numbers = range(len(motion)) if motion.frames is None else motion.frames.tolist()
            seen = [cameras[min(number, len(cameras.cameras) - 1)] for number in numbers]
            worlds = [invert_rigid(camera.camera_from_world) for camera in seen]
            motion = transform_motion(motion, np.stack(worlds), shaped.joints[0])
        return replace(motion, space="world")
    if motion.camera_from_world is not None and not cameras_given:
        moved_in = transform_motion(motion, motion.camera_from_world, shaped.joints[0])
        return replace(moved_in, camera_from_world=None)
    return motion


def anchor_at_pelvis(motion: Motion, joints: JointPlaces) -> Motion:
    """The same poses with `root_translations` as SMPL has them, for a body's rest joints.

    world = R (x - a) + t is R (x - J0) + J0 + t' with t' = t + R (J0 - a) - J0.
    """
    pelvis = joints[0]
    if motion.anchor == "pelvis":
        if motion.body_model != "smplx":
            return motion
        shifted = motion.root_translations + (SMPLX_PELVIS - pelvis)
        return replace(motion, root_translations=shifted)
    anchor = np.zeros(3) if motion.anchor == "origin" else joints[1:3].mean(axis=0)
    turned = rotation_matrices(motion.root_rotations) @ (pelvis - anchor)
    return replace(
        motion, anchor="pelvis", root_translations=motion.root_translations + turned - pelvis
    )


def transform_motion(
    motion: Motion, a_from_b: Float[np.ndarray, "poses 4 4"], pelvis: Vector3
) -> Motion:
    """The same poses in another world, x' = A x + b a row: t' = A (J0 + t) + b - J0."""
    turn, shift = a_from_b[:, :3, :3], a_from_b[:, :3, 3]
    at = np.einsum("nab,nb->na", turn, pelvis + motion.root_translations) + shift
    return replace(
        motion,
        root_rotations=axis_angles_from_matrices(turn @ rotation_matrices(motion.root_rotations)),
        root_translations=at - pelvis,
    )


def place_by_pixels(
    joints: Float[np.ndarray, "joints 3"], pixels: Float[np.ndarray, "joints 2"], camera: Camera
) -> Vector3:
    """Shift of a body so that a camera sees its joints at given pixels.

    Linear least squares over the joints, rows f t_x - (u - c) t_z = (u - c) z - f x. Joints are in
    the camera's axes, from any place; the camera's own place and distortion do not matter.
    """
    middle = joints.mean(axis=0)
    shape = joints - middle
    focal, away = np.array(camera.focal_px), pixels - np.array(camera.center_px)
    rows = np.zeros((len(joints), 2, 3))
    rows[:, 0, 0], rows[:, 1, 1] = focal
    rows[:, :, 2] = -away
    right = away * shape[:, 2:] - focal * shape[:, :2]
    solved, *_ = np.linalg.lstsq(rows.reshape(-1, 3), right.reshape(-1), rcond=None)
    return solved - middle  # the rows are about the joints' middle


def _refocus_motion(motion: Motion, shaped: ShapedBody, camera: Camera) -> Motion:
    """The motion as the true camera sees it where the tracker's own, of another K, did."""
    intrinsic = tracker_intrinsic_matrix(motion, camera.size_px)
    if intrinsic is None:
        return motion
    off = np.abs(intrinsic - camera.intrinsic)[:2]
    if (off <= 0.01 * max(camera.focal_px)).all():
        return motion
    shifted = motion.root_translations.copy()
    focal, center = np.diag(intrinsic)[:2], intrinsic[:2, 2]
    for row in np.flatnonzero(motion.valid):
        joints = shaped.with_pose(motion[int(row)]).joints()
        if (joints[:, 2] > 0.0).all():
            pixels = joints[:, :2] / joints[:, 2:] * focal + center
            shifted[row] += place_by_pixels(joints, pixels, camera)
    return replace(motion, root_translations=shifted)
